//! The parameter vault: the parameters of drives read, kept, compared and restored. The next request of a reading, the next
//! write of a restore, files and differences are pure; `store` and `journal` have the files on disk, `vault` the readings
//! and restores in progress; `north::parameter_jobs` carries them out.

mod claims;
mod difference;
mod file;
mod journal;
mod names;
mod plan;
mod reading;
mod restoration;
mod store;
mod vault;

pub use claims::{Claim, Claims, claims};
pub use difference::{Difference, differences};
pub use file::{Entry, FileError, Id, ParameterFile};
pub use journal::{Journal, JournalFile, NO_IDENTIFICATION, Owner, Phase};
pub use names::{Names, cells};
pub use plan::{Handling, NOT_KNOWN, Need, ParameterWrite, Plan, Risk, Wishes, plan};
pub use reading::{Next, Reading};
pub use restoration::{End, Restoration, RestoreNeed, Then};
pub use store::{Store, StoredFile, read};
pub use vault::{Prepared, RestoreStage, RestoreStatus, Status, Vault};
