//! The north sides: Modbus TCP, MQTT, HTTP and the local socket. They read the process image and queue commands; they never
//! name the bus.

pub mod http;
pub mod local;
pub mod metrics;
pub mod modbus_tcp;
pub mod mqtt;
pub mod register_map;
mod stats;

pub use stats::{ModbusTcpStats, MqttStats, NorthStats, Turned};
