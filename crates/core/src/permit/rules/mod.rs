//! The rules, each a pure function that answers one question about an order and one drive. A rule says in its file why it is not
//! asked at a moment at which it is not.

pub(super) mod access;
pub(super) mod age;
pub(super) mod drill;
pub(super) mod guard;
pub(super) mod holder;
pub(super) mod interlock;
pub(super) mod limits;
pub(crate) mod machine;
pub(super) mod priorities;
pub(super) mod restore_lock;
