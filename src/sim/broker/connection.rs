//! One client's connection: bytes in, packets through, bytes out. One task does both directions, so
//! that a client that only writes cannot block one that only reads.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::{Buf, BytesMut};
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::mqttbytes::v5::{ConnectReturnCode, DisconnectReasonCode, PubAckReason};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::{Notify, oneshot};
use tokio_util::sync::CancellationToken;

use super::packet::{ConnAck, Connect, Expiry, Fault, Incoming, Message, Outgoing, Publish, Version};
use super::state::{Attached, Leave};
use super::wire::{self, Refusal};
use super::{CONNECT_LIMIT, FAREWELL_LIMIT, Hub, MAX_TOPIC_ALIAS, STALL_LIMIT};

/// Bytes read at once.
const READ_BYTES: usize = 16 * 1024;
/// Bytes to send above which nothing is read and no message taken from the queue.
const OUTPUT_BYTES: usize = 64 * 1024;

/// Why a connection ends.
#[derive(Debug)]
enum End {
    /// The client's DISCONNECT.
    Left { leave: Leave, expiry: Option<Expiry> },
    /// The client or the network is gone, or tests cut it: nothing can be said any more.
    Lost(String),
    /// The broker ends it and says why.
    Closed(Fault),
}

/// Serves `stream` until it ends, the broker stops or `cut` cuts it.
pub(super) async fn serve(hub: &Arc<Hub>, mut stream: TcpStream, peer: SocketAddr, cut: CancellationToken) {
    // Small packets are to leave at once; without it they are merely later.
    let _ = stream.set_nodelay(true);
    let mut input = BytesMut::new();
    let connect = tokio::select! {
        () = hub.stop.cancelled() => return,
        () = cut.cancelled() => return,
        connect = tokio::time::timeout(CONNECT_LIMIT, receive_connect(&mut stream, &mut input)) => connect,
    };
    let connect = match connect {
        Ok(Ok(connect)) => connect,
        Ok(Err(refusal)) => {
            tracing::debug!(%peer, "connection closed: {}", refusal.what);
            return farewell(&mut stream, refusal.answer).await;
        }
        Err(_) => return tracing::debug!(%peer, "connection closed: no CONNECT within {CONNECT_LIMIT:?}"),
    };
    let now = Instant::now();
    let (end, ended) = oneshot::channel();
    let wake = Arc::new(Notify::new());
    let attached = hub.state().attach(now, &connect, Arc::clone(&wake), end);
    match attached {
        Ok(attached) => {
            let client = Client::new(hub, &connect, attached, input, now);
            client.run(stream, peer, &wake, ended, cut).await;
        }
        Err(code) => {
            tracing::debug!(%peer, "CONNECT refused: {code:?}");
            let mut answer = BytesMut::new();
            let connack = Outgoing::ConnAck(ConnAck {
                code,
                session_present: false,
                assigned: None,
            });
            wire::write(connect.version, &connack, connect.max_packet, &mut answer);
            farewell(&mut stream, &answer).await;
        }
    }
}

async fn receive_connect(stream: &mut TcpStream, input: &mut BytesMut) -> Result<Connect, Refusal> {
    loop {
        if let Some(length) = wire::packet_length(input)? {
            let connect = wire::read_connect(input.get(..length).unwrap_or_default())?;
            input.advance(length);
            return Ok(connect);
        }
        input.reserve(READ_BYTES);
        match stream.read_buf(input).await {
            Ok(0) => return Err(Fault::protocol("closed before CONNECT").into()),
            Ok(_) => {}
            Err(error) => return Err(Fault::protocol(error.to_string()).into()),
        }
    }
}

/// Sends last words, as far as the client takes them in time.
async fn farewell(stream: &mut TcpStream, bytes: &[u8]) {
    let _ = tokio::time::timeout(FAREWELL_LIMIT, async {
        stream.write_all(bytes).await?;
        stream.shutdown().await
    })
    .await;
}

/// A client after its CONNECT. However its task ends, even by a panic, dropping it tells the state.
struct Client<'a> {
    hub: &'a Hub,
    client_id: String,
    link: u64,
    version: Version,
    max_packet: u32,
    expiry: Expiry,
    keep_alive: Duration,
    /// Topics by alias - 1.
    aliases: Vec<Option<String>>,
    input: BytesMut,
    output: BytesMut,
    /// Last whole packet of the client.
    heard: Instant,
    /// Last byte the client took, or last time there was nothing to take.
    progress: Instant,
    leave: Leave,
    new_expiry: Option<Expiry>,
}

impl Drop for Client<'_> {
    fn drop(&mut self) {
        self.hub
            .state()
            .detach(Instant::now(), &self.client_id, self.link, self.leave, self.new_expiry);
    }
}

impl<'a> Client<'a> {
    fn new(hub: &'a Hub, connect: &Connect, attached: Attached, input: BytesMut, now: Instant) -> Client<'a> {
        let mut client = Client {
            hub,
            link: attached.link,
            version: connect.version,
            max_packet: connect.max_packet,
            expiry: connect.expiry,
            // One and a half times, 3.1.1 section 3.1.2.10.
            keep_alive: connect.keep_alive * 3 / 2,
            aliases: vec![None; usize::from(MAX_TOPIC_ALIAS)],
            input,
            output: BytesMut::new(),
            heard: now,
            progress: now,
            leave: Leave::Lost,
            new_expiry: None,
            client_id: attached.client_id,
        };
        client.send(&Outgoing::ConnAck(ConnAck {
            code: ConnectReturnCode::Success,
            session_present: attached.session_present,
            assigned: attached.assigned.then(|| client.client_id.clone()),
        }));
        client
    }

    async fn run(
        mut self,
        mut stream: TcpStream,
        peer: SocketAddr,
        wake: &Notify,
        ended: oneshot::Receiver<Fault>,
        cut: CancellationToken,
    ) {
        tracing::debug!(%peer, client = self.client_id, version = ?self.version, "connected");
        let mut last_words = BytesMut::new();
        let (reader, writer) = stream.split();
        match self.exchange(reader, writer, wake, ended, cut).await {
            End::Left { leave, expiry } => {
                tracing::debug!(client = self.client_id, ?leave, "disconnected");
                self.leave = leave;
                self.new_expiry = expiry;
            }
            End::Lost(what) => tracing::debug!(client = self.client_id, "connection lost: {what}"),
            End::Closed(fault) => {
                tracing::debug!(client = self.client_id, "connection closed: {}", fault.what);
                self.send(&Outgoing::Disconnect(fault.reason));
                last_words = std::mem::take(&mut self.output);
            }
        }
        // First the state, so that whoever sees the connection closed finds it done.
        drop(self);
        farewell(&mut stream, &last_words).await;
    }

    /// Works until there is a reason to end. Every branch loses nothing when another one wins.
    async fn exchange(
        &mut self,
        mut reader: impl AsyncRead + Unpin,
        mut writer: impl AsyncWrite + Unpin,
        wake: &Notify,
        mut ended: oneshot::Receiver<Fault>,
        cut: CancellationToken,
    ) -> End {
        // What came together with the CONNECT.
        if let Err(end) = self.read_packets(Instant::now()) {
            return end;
        }
        loop {
            self.fill(Instant::now());
            let open = self.output.len() < OUTPUT_BYTES;
            let deadline = self.deadline();
            self.input.reserve(READ_BYTES);
            tokio::select! {
                () = self.hub.stop.cancelled() => {
                    let what = String::from("the broker stops");
                    return End::Closed(Fault { reason: DisconnectReasonCode::ServerShuttingDown, what });
                }
                () = cut.cancelled() => return End::Lost(String::from("cut")),
                fault = &mut ended => {
                    return fault.map_or_else(|_| End::Lost(String::from("session ended")), End::Closed);
                }
                read = reader.read_buf(&mut self.input), if open => {
                    let end = match read {
                        Ok(0) => Err(End::Lost(String::from("closed by the client"))),
                        Ok(_) => self.read_packets(Instant::now()),
                        Err(error) => Err(End::Lost(error.to_string())),
                    };
                    if let Err(end) = end {
                        return end;
                    }
                }
                written = writer.write_buf(&mut self.output), if !self.output.is_empty() => match written {
                    Ok(_) => self.progress = Instant::now(),
                    Err(error) => return End::Lost(error.to_string()),
                },
                () = wake.notified(), if open => {}
                () = sleep_until(deadline) => {
                    if let Some(fault) = self.overdue(Instant::now()) {
                        return End::Closed(fault);
                    }
                }
            }
        }
    }

    /// When to look next whether the client is still there.
    fn deadline(&self) -> Option<Instant> {
        let silent = (!self.keep_alive.is_zero()).then(|| self.heard + self.keep_alive);
        let stalled = (!self.output.is_empty()).then(|| self.progress + STALL_LIMIT);
        match (silent, stalled) {
            (Some(silent), Some(stalled)) => Some(silent.min(stalled)),
            (one, other) => one.or(other),
        }
    }

    fn overdue(&self, now: Instant) -> Option<Fault> {
        if !self.output.is_empty() && now >= self.progress + STALL_LIMIT {
            let what = format!("client took no byte for {STALL_LIMIT:?}");
            return Some(Fault {
                reason: DisconnectReasonCode::QuotaExceeded,
                what,
            });
        }
        if !self.keep_alive.is_zero() && now >= self.heard + self.keep_alive {
            let what = format!("nothing heard for {:?}", self.keep_alive);
            return Some(Fault {
                reason: DisconnectReasonCode::KeepAliveTimeout,
                what,
            });
        }
        None
    }

    /// Appends a packet to the output. One that is too large for the client is left out.
    fn send(&mut self, outgoing: &Outgoing) -> bool {
        if self.output.is_empty() {
            self.progress = Instant::now();
        }
        wire::write(self.version, outgoing, self.max_packet, &mut self.output)
    }

    /// Takes messages from the queue while there is room in the output.
    fn fill(&mut self, now: Instant) {
        while self.output.len() < OUTPUT_BYTES {
            let budget = OUTPUT_BYTES - self.output.len();
            let taken = self.hub.state().take(now, &self.client_id, self.link, budget);
            if taken.is_empty() {
                return;
            }
            for outbound in taken {
                let pkid = outbound.pkid;
                // A message the client has no room for counts as delivered (MQTT 5.0 section 3.1.2.11.4).
                if !self.send(&Outgoing::Publish(outbound)) {
                    self.acknowledge(pkid);
                }
            }
        }
    }

    /// Reads all whole packets of the input.
    fn read_packets(&mut self, now: Instant) -> Result<(), End> {
        while let Some(length) = wire::packet_length(&self.input).map_err(End::Closed)? {
            let packet = self.input.split_to(length);
            self.heard = now;
            let incoming = wire::read(self.version, &packet).map_err(End::Closed)?;
            self.handle(incoming, now)?;
        }
        Ok(())
    }

    fn handle(&mut self, incoming: Incoming, now: Instant) -> Result<(), End> {
        match incoming {
            Incoming::Publish(publish) => self.publish(publish, now).map_err(End::Closed)?,
            Incoming::PubAck(pkid) => self.acknowledge(pkid),
            Incoming::PubRel(pkid) => {
                let known = self
                    .hub
                    .state()
                    .linked(&self.client_id, self.link)
                    .is_some_and(|s| s.release(pkid));
                self.send(&Outgoing::PubComp(pkid, known));
            }
            Incoming::Subscribe { pkid, filters, id } => {
                let codes = self
                    .hub
                    .state()
                    .subscribe(now, &self.client_id, self.link, &filters, id);
                self.send(&Outgoing::SubAck(pkid, codes));
            }
            Incoming::Unsubscribe { pkid, filters } => {
                let reasons = self.hub.state().unsubscribe(&self.client_id, self.link, &filters);
                self.send(&Outgoing::UnsubAck(pkid, reasons));
            }
            Incoming::PingReq => {
                self.send(&Outgoing::PingResp);
            }
            Incoming::Disconnect { reason, session_expiry } => return Err(self.left(reason, session_expiry)),
        }
        Ok(())
    }

    fn publish(&mut self, mut publish: Publish, now: Instant) -> Result<(), Fault> {
        self.resolve_alias(&mut publish)?;
        let (qos, pkid) = (publish.qos, publish.pkid);
        let mut state = self.hub.state();
        if qos == QoS::ExactlyOnce {
            let new = match state.linked(&self.client_id, self.link) {
                Some(session) => session.receive(pkid)?,
                None => false,
            };
            if !new {
                drop(state);
                self.send(&Outgoing::PubRec(pkid, PubAckReason::Success));
                return Ok(());
            }
        }
        let reason = state.publish(now, &self.client_id, Message::new(publish, now));
        if qos == QoS::ExactlyOnce && reason == PubAckReason::QuotaExceeded {
            // A refusal ends the handshake, there will be no PUBREL (MQTT 5.0 section 4.3.3).
            if self.version == Version::V5
                && let Some(session) = state.linked(&self.client_id, self.link)
            {
                session.release(pkid);
            }
        }
        drop(state);
        match qos {
            QoS::AtMostOnce => true,
            QoS::AtLeastOnce => self.send(&Outgoing::PubAck(pkid, reason)),
            QoS::ExactlyOnce => self.send(&Outgoing::PubRec(pkid, reason)),
        };
        Ok(())
    }

    /// Keeps the topic for its alias, or finds it by it (MQTT 5.0 section 3.3.2.3.4).
    fn resolve_alias(&mut self, publish: &mut Publish) -> Result<(), Fault> {
        let Some(alias) = publish.alias else { return Ok(()) };
        let known = usize::from(alias)
            .checked_sub(1)
            .and_then(|index| self.aliases.get_mut(index));
        match known {
            Some(known) if !publish.topic.is_empty() => *known = Some(publish.topic.clone()),
            Some(Some(topic)) => publish.topic.clone_from(topic),
            _ => return Err(Fault::protocol(format!("topic alias {alias} was not set"))),
        }
        Ok(())
    }

    fn acknowledge(&mut self, pkid: u16) {
        if let Some(session) = self.hub.state().linked(&self.client_id, self.link) {
            session.acknowledge(pkid);
        }
    }

    /// The end after a DISCONNECT. Any reason but the normal one publishes the will
    /// (MQTT 5.0 section 3.14.4); a session that was to end cannot be prolonged (section 3.14.2.2.2).
    fn left(&self, reason: DisconnectReasonCode, session_expiry: Option<u32>) -> End {
        let expiry = session_expiry.map(|seconds| Expiry::from_seconds(Some(seconds)));
        if self.expiry == Expiry::AtOnce && expiry.is_some_and(|expiry| expiry != Expiry::AtOnce) {
            return End::Closed(Fault::protocol("DISCONNECT prolongs a session that has no expiry"));
        }
        let leave = match reason {
            DisconnectReasonCode::NormalDisconnection => Leave::Clean,
            _ => Leave::Lost,
        };
        End::Left { leave, expiry }
    }
}

async fn sleep_until(deadline: Option<Instant>) {
    match deadline {
        Some(deadline) => tokio::time::sleep_until(deadline.into()).await,
        None => std::future::pending().await,
    }
}

#[cfg(test)]
mod tests;
