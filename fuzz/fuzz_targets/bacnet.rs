#![no_main]

#[path = "../cases/bacnet.rs"]
mod case;

libfuzzer_sys::fuzz_target!(|data: &[u8]| case::run(data));
