//! The rules, each a pure function that judges one aspect of an order to one drive. Each rule's file explains why the rule is
//! not evaluated at the other moments.

pub(super) mod access;
pub(super) mod age;
pub(super) mod awaited_file;
pub(super) mod drill;
pub(super) mod guard;
pub(super) mod holder;
pub(super) mod interlock;
pub(super) mod limits;
pub(crate) mod machine;
pub(super) mod priorities;
pub(super) mod restore_lock;
pub(super) mod standing;

#[cfg(test)]
mod tests;
