//! `[params]`.

use super::forms::*;

keys! {
    /// When [parameters](parameters.md) are read by themselves, and what they are called.
    PARAMS: Params {
        /// How often all parameters of every drive are read, one drive per bus at a time. Readings are kept in `params`
        /// of the `state_dir`; changes not made by the gateway raise an event.
        every: Duration = Time(Duration::from_secs(60)..=Duration::from_secs(366 * 86_400)), or "never";
        /// Your own lists of names, units and scales, [CSV](parameters.md#names-of-your-own); `vacon-cx.csv` is for the
        /// drives of profile `vacon-cx`.
        names: Vec<PathBuf> = List { parse: values::path, empty: None, range: "files" }, or "none";
    }
}
