//! Settings of the rumqttc client.

use std::sync::Arc;

use rumqttc::{
    ConnectProperties, LastWill, MqttOptions, NetworkOptions, Proxy, ProxyAuth, ProxyType, TlsConfiguration, Transport,
};
use rustls::ClientConfig;

use super::super::dial::ACCEPT_TIMEOUT;
use super::super::keep_alive::KEEP_ALIVE_S;
use super::super::{Broker, Options};
use super::INFLIGHT;

/// Messages that are written to the socket, or read from it, at once.
const BATCH: usize = 16;
/// Maximum size of a packet from the broker: much larger than any valid command, so that a command that is too long
/// still gets an answer. Brokers drop larger packets silently.
const MAX_PACKET: u32 = 2 << 20;
/// Number of unacknowledged commands that the broker may send.
const RECEIVE_MAXIMUM: u16 = 64;
/// Size of the system's buffer for sent messages: a result never waits for more than this.
const SEND_BUFFER: u32 = 256 << 10;

/// Settings for a connection to `broker` as this client, with this last will.
pub(super) fn mqtt_options(
    options: &Options,
    broker: &Broker,
    client_id: &str,
    will: LastWill,
    tls: Option<Arc<ClientConfig>>,
) -> MqttOptions {
    let mut mqtt = MqttOptions::new(client_id, target(broker));
    if let Some((host, port)) = &options.proxy {
        mqtt.set_proxy(Proxy {
            ty: ProxyType::Http,
            auth: ProxyAuth::None,
            addr: host.clone(),
            port: *port,
        });
    }
    let mut properties = ConnectProperties::new();
    properties.max_packet_size = Some(MAX_PACKET);
    properties.receive_maximum = Some(RECEIVE_MAXIMUM);
    mqtt.set_connect_properties(properties);
    mqtt.set_keep_alive(KEEP_ALIVE_S)
        .set_clean_start(true)
        .set_connect_timeout(ACCEPT_TIMEOUT)
        .set_max_request_batch(BATCH)
        .set_read_batch_size(BATCH)
        .set_outgoing_inflight_upper_limit(INFLIGHT)
        .set_last_will(will);
    let mut network = NetworkOptions::new();
    network.set_tcp_nodelay(true);
    network.set_tcp_send_buffer_size(SEND_BUFFER);
    mqtt.set_network_options(network);
    if let Some(config) = tls {
        let config = TlsConfiguration::Rustls(config);
        mqtt.set_transport(match broker.path {
            None => Transport::tls_with_config(config),
            Some(_) => Transport::Wss(config),
        });
    }
    mqtt
}

/// The broker's address in the form of the library.
fn target(broker: &Broker) -> rumqttc::Broker {
    // TLS would take an IPv6 address with brackets for a name.
    let plain = || rumqttc::Broker::tcp(broker.bare_host(), broker.port);
    let Some(path) = &broker.path else { return plain() };
    // An invalid URL was refused with the configuration.
    rumqttc::Broker::websocket(format!("ws://{broker}{path}")).unwrap_or_else(|_| plain())
}
