#![no_main]

#[path = "../cases/modbus_tcp_stream.rs"]
mod case;

libfuzzer_sys::fuzz_target!(|data: &[u8]| case::run(data));
