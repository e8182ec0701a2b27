//! Points, profiles and quality of frequency converters; TOML that knows the line of every key.

#![warn(missing_docs)]

pub mod document;
pub mod drive;
