//! The parameter vault: the parameters of drives read, kept, compared. What a reading asks next, files and differences are
//! pure; `store` has the files on disk, `vault` the readings
//! that go on; `north::parameters` does them.

mod difference;
mod file;
mod names;
mod plan;
mod reading;
mod store;
mod vault;

pub use difference::{Difference, differences};
pub use file::{Entry, FileError, Id, ParameterFile};
pub use names::Names;
pub use plan::{Handling, Need, ParameterWrite, Plan, Risk, Wishes, plan};
pub use reading::{Next, Reading};
pub use store::{Kept, Store, read};
pub use vault::{Status, Vault};
