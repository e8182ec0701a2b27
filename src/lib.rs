//! drivegate.
pub mod bus;
pub mod cache;
pub mod cli;
pub mod codec;
pub mod command;
pub mod config;
pub mod daemon;
pub mod document;
pub mod drive;
pub mod event;
pub mod line;
pub mod north;
pub mod plant;
pub mod sim;
