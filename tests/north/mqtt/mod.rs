//! The MQTT client against Debian's Mosquitto and its clients.

mod bench;
mod certificates;
mod clouds;
mod commands;
mod delivery;
mod failover;
mod home_assistant;
mod hostile;
mod puppet;
mod sparkplug;
mod telemetry;
mod tls;
