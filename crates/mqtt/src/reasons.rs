//! Why a connection to a broker was lost or did not come about, in words.

use rumqttc::mqttbytes::Error as PacketError;
use rumqttc::mqttbytes::v5::Disconnect;
use rumqttc::{ConnectReturnCode, ConnectionError, DisconnectReasonCode, StateError};

use drivegate_north::tls::{self, BROKER};

/// Why there is no connection yet. A broker without MQTT 5 answers in the form of an older version, which is not a packet
/// of MQTT 5, and closes the connection; some close it at once.
pub(super) fn refusal(error: &ConnectionError) -> String {
    let is_of_tls = |error: &(dyn std::error::Error + 'static)| tls::explain(error, BROKER).is_some();
    match error {
        _ if is_of_tls(error) => reason(error),
        // A port that nobody listens at, a name that is not known.
        ConnectionError::Io(_) if !is_closed(error) => reason(error),
        ConnectionError::MqttState(StateError::Deserialization(PacketError::Io(io))) if is_of_tls(io) => reason(error),
        ConnectionError::Io(io)
        | ConnectionError::MqttState(StateError::Io(io) | StateError::Deserialization(PacketError::Io(io))) => {
            if is_closed(error) {
                format!("{io}: the broker did not accept the connection; {SCHEME}")
            } else {
                format!("there is no MQTT at this port ({io}); {SCHEME}")
            }
        }
        ConnectionError::Timeout(_) => format!("timed out: the broker did not accept the connection; {SCHEME}"),
        ConnectionError::MqttState(StateError::ConnectionAborted | StateError::Deserialization(_)) => format!(
            "the broker closed the connection without accepting it: it does not support MQTT 5, or expects TLS; {MQTT_5}, or \
             {SCHEME}"
        ),
        ConnectionError::Websocket(why) => format!("{why}: {WEB}"),
        ConnectionError::ResponseValidation(why) => format!("{why}: {WEB}"),
        _ => reason(error),
    }
}

/// Remedy where the other end does not answer as a broker: often TLS is the cause.
const SCHEME: &str = "check the scheme in mqtt.url: mqtts:// for a port with TLS, usually 8883, mqtt:// for one without, \
                      usually 1883";

/// Remedy where the other end does not answer in WebSocket.
const WEB: &str = "there is no MQTT over WebSocket at this port and path; check mqtt.url: ws:// or wss:// with the port and \
                   path of the broker's WebSocket, mqtt:// or mqtts:// for a port without";

/// Remedy for a broker of an older version.
const MQTT_5: &str = "the gateway requires MQTT 5: use Mosquitto 1.6 or later, or another broker that supports it";

/// The broker ended an accepted connection, and did not say why.
pub(super) const CLOSED: &str = "the broker closed the connection without a reason";

/// The server that a broker names when it sends its clients to another one. The gateway does not follow: it would send its
/// password to a server that nobody configured.
pub(super) fn reference(disconnect: &Disconnect) -> String {
    let named = disconnect
        .properties
        .as_ref()
        .and_then(|all| all.server_reference.as_deref());
    match (disconnect.reason_code, named) {
        (DisconnectReasonCode::UseAnotherServer, Some(server)) => {
            format!("; the broker asks its clients to use {server:?} for now: add it to mqtt.urls")
        }
        (DisconnectReasonCode::ServerMoved, Some(server)) => {
            format!("; the broker has moved to {server:?}: write that to mqtt.url")
        }
        _ => String::new(),
    }
}

/// The broker ended the connection before TLS was there, and did not say why.
const HANDSHAKE_END: &str = "the broker closed the connection during the TLS handshake: perhaps it does not use TLS \
                             on this port, or refuses the gateway; check the broker's log, and mqtt.url: mqtts:// for a \
                             port with TLS, usually 8883, mqtt:// for one without, usually 1883";

/// Whether the other end closed the connection.
pub(super) fn is_closed(error: &ConnectionError) -> bool {
    let io = match error {
        ConnectionError::MqttState(StateError::ConnectionAborted) => return true,
        ConnectionError::MqttState(StateError::Io(io) | StateError::Deserialization(PacketError::Io(io)))
        | ConnectionError::Io(io) => io,
        _ => return false,
    };
    use std::io::ErrorKind::{BrokenPipe, ConnectionAborted, ConnectionReset, UnexpectedEof};
    matches!(
        io.kind(),
        BrokenPipe | ConnectionAborted | ConnectionReset | UnexpectedEof
    )
}

fn in_words(error: &(dyn std::error::Error + 'static)) -> String {
    tls::in_words(error, BROKER)
}

pub(super) fn reason(error: &ConnectionError) -> String {
    use ConnectReturnCode::{
        BadUserNamePassword, Banned, ClientIdentifierNotValid, NotAuthorized, UnsupportedProtocolVersion,
    };
    let ConnectionError::ConnectionRefused(code) = error else {
        return match error {
            ConnectionError::Timeout(_) => "timed out".to_string(),
            ConnectionError::MqttState(StateError::AwaitPingResp) => "the broker no longer responds".to_string(),
            ConnectionError::MqttState(StateError::ConnectionAborted) => CLOSED.to_string(),
            ConnectionError::Tls(tls) if tls::is_handshake_end(tls) => HANDSHAKE_END.to_string(),
            ConnectionError::Io(io) if tls::explain(io, BROKER).is_none() => {
                format!("{io}; check mqtt.url, and whether the broker is running")
            }
            // A decoding error may hide a read error, as after an alert of TLS 1.3.
            ConnectionError::MqttState(StateError::Deserialization(PacketError::Io(io))) => in_words(io),
            _ => in_words(error),
        };
    };
    if *code == UnsupportedProtocolVersion {
        return format!("the broker refuses the protocol version ({code:?}); {MQTT_5}");
    }
    let advice = match code {
        BadUserNamePassword | NotAuthorized | Banned => {
            "; check mqtt.username, mqtt.password_file and the permissions on the broker"
        }
        ClientIdentifierNotValid => "; change mqtt.client_id",
        _ => "",
    };
    format!("the broker refuses the connection ({code:?}){advice}")
}

#[cfg(test)]
mod tests {
    use rumqttc::DisconnectProperties;

    use super::*;

    #[test]
    fn a_broker_that_sends_its_clients_elsewhere_names_where() {
        let told = |code, server: Option<&str>| {
            let mut disconnect = Disconnect::new(code);
            disconnect.properties = Some(DisconnectProperties {
                session_expiry_interval: None,
                reason_string: None,
                user_properties: Vec::new(),
                server_reference: server.map(str::to_string),
            });
            reference(&disconnect)
        };
        use DisconnectReasonCode::{ServerBusy, ServerMoved, UseAnotherServer};
        assert!(told(UseAnotherServer, Some("b-2:8883")).contains("\"b-2:8883\" for now: add it to mqtt.urls"));
        assert!(told(ServerMoved, Some("b-2:8883")).contains("moved to \"b-2:8883\": write that to mqtt.url"));
        assert_eq!(told(ServerMoved, None), "");
        assert_eq!(told(ServerBusy, Some("b-2:8883")), "");
    }
}
