//! Points, profiles and quality of frequency converters; TOML that knows the line of every key.

pub mod document;
pub mod drive;
