//! When an order may move a motor: the rules, one file each. Pure.

pub mod rules;
