//! The connection of one client: bytes in, packets through, bytes out. One task handles both directions, so that a
//! client that only writes cannot block one that only reads.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::{Notify, oneshot};

use super::packet::{self, Connect, Fault, Incoming, Qos, Version, fault, reason};
use super::state::Leave;
use super::{CONNECT_LIMIT, FAREWELL_LIMIT, MAX_INFLIGHT, STALL_LIMIT, Shared};

/// Maximum number of bytes read at once.
const READ_BYTES: usize = 16 * 1024;
/// Bytes to send above which nothing is read and no message is taken from the queue.
const OUTPUT_BYTES: usize = 64 * 1024;

/// Why the connection of a client ends.
enum End {
    /// The client's DISCONNECT.
    Left { with_will: bool },
    /// The client or the network has gone.
    Lost,
    /// The broker ends the connection.
    Closed(Fault),
}

/// Serves `stream` until the connection ends or the broker stops.
pub(super) async fn serve(shared: &Shared, mut stream: TcpStream, peer: SocketAddr) {
    // Small packets should be sent at once; if this option fails, they are only sent later.
    let _ = stream.set_nodelay(true);
    let mut input = Vec::new();
    let connect = tokio::select! {
        () = shared.stop.cancelled() => return,
        connect = tokio::time::timeout(CONNECT_LIMIT, receive_connect(&mut stream, &mut input)) => connect,
    };
    let connect = match connect {
        Ok(Some(Ok(connect))) => connect,
        Ok(Some(Err(fault))) => {
            tracing::debug!(target: "drivegate::sim::broker", %peer, "connection closed: {}", fault.what);
            if fault.reason == reason::UNSUPPORTED_VERSION {
                farewell(&mut stream, &packet::UNSUPPORTED_CONNACK).await;
            }
            return;
        }
        Ok(None) | Err(_) => {
            return tracing::debug!(target: "drivegate::sim::broker", %peer, "connection closed: no CONNECT");
        }
    };
    if let Some(code) = connect.refused {
        tracing::debug!(target: "drivegate::sim::broker", %peer, "CONNECT refused with reason code {code:#04x}");
        return farewell(&mut stream, &packet::connack(connect.version, code, None)).await;
    }
    let (end, ended) = oneshot::channel();
    let wake = Arc::new(Notify::new());
    let client = Client::attach(shared, connect, input, Arc::clone(&wake), end);
    tracing::debug!(target: "drivegate::sim::broker", %peer, client = client.id, "connected");
    client.run(stream, &wake, ended).await;
}

/// Receives the CONNECT; `None` if the connection ends before that.
async fn receive_connect(stream: &mut TcpStream, input: &mut Vec<u8>) -> Option<Result<Connect, Fault>> {
    loop {
        match packet::packet_length(input) {
            Ok(Some(length)) => {
                let packet: Vec<u8> = input.drain(..length).collect();
                return Some(packet::read_connect(&packet, Instant::now()));
            }
            Ok(None) => {}
            Err(fault) => return Some(Err(fault)),
        }
        input.reserve(READ_BYTES);
        if !matches!(stream.read_buf(input).await, Ok(1..)) {
            return None;
        }
    }
}

/// Sends the last bytes of a connection, as far as the client accepts them in time.
async fn farewell(stream: &mut TcpStream, bytes: &[u8]) {
    let _ = tokio::time::timeout(FAREWELL_LIMIT, async {
        stream.write_all(bytes).await?;
        stream.shutdown().await
    })
    .await;
}

/// A client after its CONNECT. However its task ends, even by a panic, dropping this value detaches the client from
/// the state.
struct Client<'a> {
    shared: &'a Shared,
    number: u64,
    id: String,
    version: Version,
    max_packet: usize,
    /// Maximum number of QoS 1 messages in transit.
    window: usize,
    /// Packet identifiers of messages that are not acknowledged yet.
    inflight: BTreeSet<u16>,
    last_pkid: u16,
    /// Longest silence of the client; zero allows any silence.
    silence: Duration,
    input: Vec<u8>,
    output: Vec<u8>,
    /// When the last whole packet of the client arrived.
    heard: Instant,
    /// Time when the client last took a byte, or when the broker last had nothing to send.
    progress: Instant,
    leave: Leave,
}

impl Drop for Client<'_> {
    fn drop(&mut self) {
        self.shared.state().detach(self.number, self.leave, Instant::now());
    }
}

impl<'a> Client<'a> {
    fn attach(
        shared: &'a Shared,
        connect: Connect,
        input: Vec<u8>,
        wake: Arc<Notify>,
        end: oneshot::Sender<Fault>,
    ) -> Client<'a> {
        let now = Instant::now();
        let number = shared.connections.fetch_add(1, Ordering::Relaxed);
        let assigned = connect.client_id.is_empty().then(|| format!("drivegate-demo-{number}"));
        let id = assigned.clone().unwrap_or(connect.client_id);
        shared.state().attach(number, &id, connect.will, wake, end, now);
        let mut client = Client {
            shared,
            number,
            id,
            version: connect.version,
            max_packet: connect.max_packet,
            window: connect.receive_maximum.min(MAX_INFLIGHT),
            inflight: BTreeSet::new(),
            last_pkid: 0,
            // The client may be silent for one and a half keep-alive periods (3.1.1 section 3.1.2.10).
            silence: connect.keep_alive * 3 / 2,
            input,
            output: Vec::new(),
            heard: now,
            progress: now,
            leave: Leave::Lost,
        };
        client.send(&packet::connack(connect.version, reason::SUCCESS, assigned.as_deref()));
        client
    }

    async fn run(mut self, mut stream: TcpStream, wake: &Notify, ended: oneshot::Receiver<Fault>) {
        let (reader, writer) = stream.split();
        match self.exchange(reader, writer, wake, ended).await {
            End::Left { with_will: false } => self.leave = Leave::Clean,
            End::Left { with_will: true } | End::Lost => {}
            End::Closed(fault) => {
                tracing::debug!(target: "drivegate::sim::broker", client = self.id, "connection closed: {}", fault.what);
                self.send(&packet::disconnect(self.version, fault.reason));
            }
        }
        let last_words = std::mem::take(&mut self.output);
        // The state is released before the connection closes, so that a peer that sees the close finds the cleanup done.
        drop(self);
        farewell(&mut stream, &last_words).await;
    }

    /// Serves the client until there is a reason to end. No branch of the select loses data when another one completes.
    async fn exchange(
        &mut self,
        mut reader: impl AsyncRead + Unpin,
        mut writer: impl AsyncWrite + Unpin,
        wake: &Notify,
        mut ended: oneshot::Receiver<Fault>,
    ) -> End {
        loop {
            if let Err(end) = self.read_packets(Instant::now()) {
                return end;
            }
            self.fill(Instant::now());
            let open = self.output.len() < OUTPUT_BYTES;
            let deadline = self.deadline();
            self.input.reserve(READ_BYTES);
            tokio::select! {
                () = self.shared.stop.cancelled() => {
                    return End::Closed(fault(reason::SERVER_SHUTTING_DOWN, "the broker stops"));
                }
                fault = &mut ended => return fault.map_or(End::Lost, End::Closed),
                read = reader.read_buf(&mut self.input), if open => {
                    if !matches!(read, Ok(1..)) {
                        return End::Lost;
                    }
                }
                written = writer.write(&self.output), if !self.output.is_empty() => match written {
                    Ok(count @ 1..) => {
                        self.output.drain(..count);
                        self.progress = Instant::now();
                    }
                    _ => return End::Lost,
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

    fn silent_at(&self) -> Option<Instant> {
        (!self.silence.is_zero()).then(|| self.heard + self.silence)
    }

    fn stalled_at(&self) -> Option<Instant> {
        (!self.output.is_empty()).then(|| self.progress + STALL_LIMIT)
    }

    /// When to check next whether the client is still connected.
    fn deadline(&self) -> Option<Instant> {
        self.silent_at().into_iter().chain(self.stalled_at()).min()
    }

    fn overdue(&self, now: Instant) -> Option<Fault> {
        let past = |at: Option<Instant>| at.is_some_and(|at| at <= now);
        if past(self.stalled_at()) {
            Some(fault(reason::QUOTA_EXCEEDED, "the client takes no bytes"))
        } else if past(self.silent_at()) {
            Some(fault(
                reason::KEEP_ALIVE_TIMEOUT,
                "silent for longer than its keep alive allows",
            ))
        } else {
            None
        }
    }

    /// Appends a packet to the output, unless the client does not take one so large.
    fn send(&mut self, packet: &[u8]) -> bool {
        if self.output.is_empty() {
            self.progress = Instant::now();
        }
        let fits = packet.len() <= self.max_packet;
        if fits {
            self.output.extend_from_slice(packet);
        }
        fits
    }

    /// Takes messages from the queue while the output has room.
    fn fill(&mut self, now: Instant) {
        while self.output.len() < OUTPUT_BYTES {
            let room = self.inflight.len() < self.window;
            let next = self.shared.state().take(self.number, room, now);
            let Some(next) = next else { return };
            let pkid = match next.qos {
                Qos::AtMostOnce => 0,
                Qos::AtLeastOnce => self.free_pkid(),
            };
            let packet = packet::publish(self.version, &next.message, next.retain, pkid, now);
            // A message that is too large counts as delivered (MQTT 5.0 section 3.1.2.11.4).
            if self.send(&packet) && pkid != 0 {
                self.inflight.insert(pkid);
            }
        }
    }

    /// A packet identifier that is not in use; far fewer than exist can be in use at a time.
    fn free_pkid(&mut self) -> u16 {
        loop {
            self.last_pkid = self.last_pkid.checked_add(1).unwrap_or(1);
            if !self.inflight.contains(&self.last_pkid) {
                return self.last_pkid;
            }
        }
    }

    /// Reads all whole packets from the input.
    fn read_packets(&mut self, now: Instant) -> Result<(), End> {
        let input = std::mem::take(&mut self.input);
        let mut rest = input.as_slice();
        while let Some(length) = packet::packet_length(rest).map_err(End::Closed)? {
            let (packet, behind) = rest.split_at_checked(length).unwrap_or((rest, &[]));
            rest = behind;
            self.heard = now;
            let incoming = packet::read(self.version, packet, now).map_err(End::Closed)?;
            self.handle(incoming, now)?;
        }
        self.input = rest.to_vec();
        Ok(())
    }

    fn handle(&mut self, incoming: Incoming, now: Instant) -> Result<(), End> {
        match incoming {
            Incoming::Publish(message, pkid) => {
                let kept = self.shared.state().publish(self.number, message, now);
                if pkid != 0 {
                    let reason = if kept { reason::SUCCESS } else { reason::QUOTA_EXCEEDED };
                    self.send(&packet::acknowledge(self.version, packet::PUBACK, pkid, &[reason]));
                }
            }
            Incoming::PubAck(pkid) => drop(self.inflight.remove(&pkid)),
            Incoming::Subscribe(pkid, wanted) => {
                let codes = self.shared.state().subscribe(self.number, wanted, now);
                self.send(&packet::acknowledge(self.version, packet::SUBACK, pkid, &codes));
            }
            Incoming::Unsubscribe(pkid, filters) => {
                let codes = self.shared.state().unsubscribe(self.number, &filters);
                self.send(&packet::acknowledge(self.version, packet::UNSUBACK, pkid, &codes));
            }
            Incoming::PingReq => drop(self.send(&packet::PINGRESP)),
            Incoming::Disconnect { with_will } => return Err(End::Left { with_will }),
        }
        Ok(())
    }
}

async fn sleep_until(deadline: Option<Instant>) {
    match deadline {
        Some(deadline) => tokio::time::sleep_until(deadline.into()).await,
        None => std::future::pending().await,
    }
}
