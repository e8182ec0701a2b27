//! The link of a client to one of its brokers: which broker is tried next and when, the last will in a form that
//! the broker accepts, the subscriptions, silence, and the log of outages. The client decides what is published and
//! received.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use rumqttc::mqttbytes::v5::Filter;
use rustls::ClientConfig;
use tokio::sync::Semaphore;
use tokio::task::JoinHandle;

use super::back_off::Rotation;
use super::broker_limits::{BrokerLimits, WillForm};
use super::connection::{Connection, NO_WILDCARDS, SUBSCRIBE_TIMEOUT, Step};
use super::dial::Dial;
use super::outage_log::OutageLog;
use super::outbox::Message;
use super::reasons::CLOSED;
use super::session::Will;
use super::takeover::Takeovers;
use super::{Broker, Options, Password, Secret};
use drivegate_north::patience::{DISK, late};
use drivegate_north::{LinkStatus, tls};

/// The reasons of a broker that does not accept a password (any more): 0x86 and 0x87.
const CREDENTIALS: [&str; 2] = ["BadUserNamePassword", "NotAuthorized"];

/// The next action that the link needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Due {
    Nothing,
    /// The next attempt to connect is due.
    Connect,
    /// The connection must be given up, for this reason.
    GiveUp(&'static str),
}

/// Configuration of TLS and the password of an attempt.
type Credentials = (Option<Arc<ClientConfig>>, Option<Secret>);

#[derive(Debug)]
enum State {
    /// No connection; the next attempt follows at `retry_at`.
    Down { retry_at: Instant },
    /// Certificates and password are being read; the connection will have this last will.
    Reading(JoinHandle<Result<Credentials, String>>, Will),
    /// An open connection that the broker may not have accepted yet.
    Up(Box<Connection>, Phase),
}

#[derive(Debug, Clone, Copy)]
enum Phase {
    Connecting,
    Subscribing { limits: BrokerLimits, since: Instant },
    Ready { limits: BrokerLimits, since: Instant },
}

impl Phase {
    /// The broker's capabilities; `None` until they are known.
    fn limits(&self) -> Option<&BrokerLimits> {
        match self {
            Phase::Connecting => None,
            Phase::Subscribing { limits, .. } | Phase::Ready { limits, .. } => Some(limits),
        }
    }
}

/// The link of one client.
#[derive(Debug)]
pub(super) struct BrokerLink {
    options: Arc<Options>,
    client_id: String,
    /// Prefix of the link's log lines.
    prefix: &'static str,
    state: State,
    rotation: Rotation,
    dial: Dial,
    will: WillForm,
    /// Outages of each broker.
    outages: Vec<OutageLog>,
    takeovers: Takeovers,
    /// The password of the last attempt.
    password: Option<Secret>,
    /// A password from a file that the broker refused, and when it may be tried again.
    refused: Option<(Secret, Instant)>,
    /// The right to read the files: one thread at most waits for a disk that hangs.
    reads: Arc<Semaphore>,
    status: Arc<LinkStatus>,
}

impl Drop for BrokerLink {
    fn drop(&mut self) {
        self.status.end();
    }
}

impl BrokerLink {
    /// A link that starts with the broker `kept`, which worked before a reload, if that broker is still configured.
    pub(super) fn new(
        options: Options,
        client_id: String,
        prefix: &'static str,
        status: Arc<LinkStatus>,
        kept: Option<&Broker>,
    ) -> BrokerLink {
        let brokers = &options.brokers;
        let first = kept.and_then(|kept| brokers.iter().position(|broker| broker == kept));
        let link = BrokerLink {
            rotation: Rotation::new(brokers.len(), first.unwrap_or(0)),
            outages: brokers.iter().map(|_| OutageLog::default()).collect(),
            client_id,
            prefix,
            state: State::Down {
                retry_at: Instant::now(),
            },
            dial: Dial::default(),
            will: WillForm::first(options.retain),
            options: Arc::new(options),
            takeovers: Takeovers::default(),
            password: None,
            refused: None,
            reads: Arc::new(Semaphore::new(1)),
            status,
        };
        link.status.begin(link.broker().to_string(), SystemTime::now());
        link
    }

    /// The broker that is tried at present.
    pub(super) fn broker(&self) -> Broker {
        let broker = self.options.brokers.get(self.rotation.current());
        broker.cloned().unwrap_or_default()
    }

    pub(super) fn client_id(&self) -> &str {
        &self.client_id
    }

    pub(super) fn is_up(&self) -> bool {
        matches!(self.state, State::Up(..))
    }

    /// Capabilities of the broker; `None` until it has accepted the connection.
    pub(super) fn limits(&self) -> Option<BrokerLimits> {
        match &self.state {
            State::Up(_, phase) => phase.limits().copied(),
            State::Down { .. } | State::Reading(..) => None,
        }
    }

    /// Capabilities of the broker; `None` until it has answered the subscriptions.
    pub(super) fn ready(&self) -> Option<BrokerLimits> {
        match &self.state {
            State::Up(_, Phase::Ready { limits, .. }) => Some(*limits),
            _ => None,
        }
    }

    /// The next event of the connection; waits until there is one. Cancel safe.
    pub(super) async fn next(&mut self) -> Step {
        let step = match &mut self.state {
            State::Down { .. } => std::future::pending().await,
            State::Reading(reading, _) => {
                let read = reading.await.unwrap_or_else(|error| Err(error.to_string()));
                return self.open(read);
            }
            State::Up(connection, _) => connection.next().await,
        };
        self.apply(step)
    }

    fn apply(&mut self, step: Step) -> Step {
        let State::Up(_, phase) = &mut self.state else {
            return Step::Nothing;
        };
        match (step, &mut *phase) {
            (Step::Accepted(limits), _) => {
                let since = Instant::now();
                let retains = limits.retains && self.options.retain;
                let limits = BrokerLimits { retains, ..limits };
                *phase = Phase::Subscribing { limits, since };
                Step::Accepted(limits)
            }
            (Step::Subscribed(answers), Phase::Subscribing { limits, .. })
                if limits.wildcards && answers.iter().flatten().any(|why| why == NO_WILDCARDS) =>
            {
                limits.wildcards = false;
                Step::Subscribe(*limits)
            }
            // Another connection with a simpler last will follows at once, if there is such a will.
            (Step::Refuses(lack), _) if self.will.lessen(lack) => {
                tracing::debug!(target: "drivegate::north::mqtt", "{}the broker refuses the last will ({lack:?}); trying a lesser one", self.prefix);
                self.state = State::Down {
                    retry_at: Instant::now(),
                };
                Step::Nothing
            }
            (Step::Refuses(_), _) => Step::Lost("the broker refuses the last will in every form".to_string()),
            (step, _) => step,
        }
    }

    /// Notes that the broker answered the subscriptions; returns the broker's limits if that was the first time on
    /// this connection, since the client may then publish.
    pub(super) fn become_ready(&mut self) -> Option<BrokerLimits> {
        let State::Up(_, phase) = &mut self.state else {
            return None;
        };
        let Phase::Subscribing { limits, since } = *phase else {
            return None;
        };
        *phase = Phase::Ready { limits, since };
        Some(limits)
    }

    /// The action that is due now.
    pub(super) fn due(&mut self, now: Instant) -> Due {
        match &mut self.state {
            State::Down { retry_at } if now >= *retry_at => Due::Connect,
            State::Down { .. } | State::Reading(..) => Due::Nothing,
            State::Up(_, Phase::Subscribing { since, .. })
                if now.saturating_duration_since(*since) > SUBSCRIBE_TIMEOUT =>
            {
                Due::GiveUp("the broker does not reply to the subscription")
            }
            State::Up(connection, phase) => {
                if connection.is_silent(phase.limits().copied(), now) {
                    Due::GiveUp("the broker is silent")
                } else {
                    Due::Nothing
                }
            }
        }
    }

    /// Starts to connect to the next broker, with this last will. Nothing waits for the disk: [`BrokerLink::next`] goes on
    /// when the files are read, and reports a lost connection if they cannot be.
    pub(super) fn connect(&mut self, will: Will) {
        let read = read_credentials(self.options.clone(), self.reads.clone());
        let read = async {
            tokio::time::timeout(DISK, read)
                .await
                .unwrap_or_else(|_| Err(late_files()))
        };
        self.state = State::Reading(tokio::spawn(read), will);
    }

    /// Opens the connection with the credentials that were read.
    fn open(&mut self, read: Result<Credentials, String>) -> Step {
        let retry_at = Instant::now();
        let State::Reading(_, will) = std::mem::replace(&mut self.state, State::Down { retry_at }) else {
            return Step::Nothing;
        };
        let (config, password) = match read {
            Ok(read) => read,
            Err(why) => return Step::Lost(why),
        };
        if let Some((_, retry_at)) = self
            .refused
            .take_if(|(refused, _)| Some(&*refused) == password.as_ref())
        {
            // A password that was refused would be refused again.
            self.state = State::Down { retry_at };
            return Step::Nothing;
        }
        self.password.clone_from(&password);
        let will = self.will.will(will);
        let broker = self.broker();
        let target = (&broker, self.client_id.as_str());
        let dial = (self.dial.clone(), self.rotation.round());
        let connection = Connection::open(&self.options, target, (will, password), config, dial);
        self.state = State::Up(Box::new(connection), Phase::Connecting);
        Step::Nothing
    }

    /// The connection that the broker accepted, and the capabilities of the broker.
    fn accepted(&mut self) -> Option<(&mut Connection, BrokerLimits)> {
        match &mut self.state {
            State::Up(connection, phase) => phase.limits().map(|limits| (&mut **connection, *limits)),
            State::Down { .. } | State::Reading(..) => None,
        }
    }

    /// Subscribes; returns false if the connection does not accept the packet.
    pub(super) fn subscribe(&mut self, filters: Vec<Filter>) -> bool {
        let accepted = self.accepted();
        accepted.is_none_or(|(connection, limits)| connection.subscribe(filters, limits))
    }

    /// Publishes a message; returns false if room or a connection is lacking.
    pub(super) fn publish(&mut self, message: Message) -> bool {
        let accepted = self.accepted();
        accepted.is_some_and(|(connection, limits)| connection.publish(message, limits))
    }

    /// Disconnects in an orderly way, so that the broker does not publish the last will; returns false if there is
    /// no accepted connection.
    pub(super) fn disconnect(&mut self) -> bool {
        let accepted = self.accepted();
        accepted.is_some_and(|(connection, limits)| connection.disconnect(limits))
    }

    /// Logs that the client may publish, with the functions that are lost with this broker.
    pub(super) fn log_ready(&mut self, limits: BrokerLimits, named: &str) {
        let (prefix, broker) = (self.prefix, self.broker());
        tracing::info!(target: "drivegate::north::mqtt", "{prefix}connected to the broker at {broker}{named}");
        // A missing feature that the configuration does not use is not reported.
        let retains = limits.retains || !self.options.retain;
        for lost in (BrokerLimits { retains, ..limits }).losses() {
            tracing::warn!(target: "drivegate::north::mqtt", "{prefix}the broker at {broker} {lost}");
        }
        if let Some(outages) = self.outages.get_mut(self.rotation.current()) {
            outages.end();
        }
        self.status.connected(broker.to_string(), SystemTime::now());
    }

    /// The connection could not be ended in order.
    pub(super) fn log_timed_out(&self) {
        tracing::warn!(target: "drivegate::north::mqtt", "{}the orderly disconnect timed out; the broker publishes the last will", self.prefix);
    }

    /// Ends the connection and sends the reason to the broker. The last will is published if it is `true_now`.
    pub(super) fn give_up(&mut self, why: &str, true_now: bool) {
        if let Some(connection) = self.lost(why) {
            connection.give_up(why, true_now);
        }
    }

    /// Notes that the connection was lost for this reason; returns it. Dropping it aborts its task and closes the socket.
    pub(super) fn lost(&mut self, why: &str) -> Option<Connection> {
        let (now, prefix, broker) = (Instant::now(), self.prefix, self.broker());
        self.status.lost(broker.to_string(), why, SystemTime::now());
        let place = self.rotation.current();
        let before = self.turn_to_next(None, now);
        self.read_password_again(why, now);
        // All connections closed without a reason count as one reason, whatever the last packet was.
        let closed = why.starts_with(CLOSED);
        let kind = if closed { CLOSED } else { why };
        if self
            .outages
            .get_mut(place)
            .is_some_and(|outages| outages.permit(kind, now))
        {
            let hint = if why.contains("SessionTakenOver") {
                "; another client has the same client id: give each gateway its own name or `client_id`"
            } else {
                ""
            };
            let next = if self.rotation.is_single() {
                "reconnecting".to_string()
            } else {
                format!("the next one is {}", self.broker())
            };
            tracing::warn!(target: "drivegate::north::mqtt", "{prefix}no connection to the broker at {broker}: {why}{hint}; {next}");
        } else {
            tracing::debug!(target: "drivegate::north::mqtt", "{prefix}no connection to the broker at {broker}: {why}");
        }
        if closed && self.takeovers.closed(now) {
            let words = Takeovers::log_text(&self.client_id);
            tracing::warn!(target: "drivegate::north::mqtt", "{prefix}{broker}: {words}");
        }
        before
    }

    /// Allows another attempt with the password file: a broker that no longer accepts the old password may accept
    /// the new content.
    fn read_password_again(&mut self, why: &str, now: Instant) {
        let is_refused = CREDENTIALS.iter().any(|code| why.contains(code));
        if let (true, Some(Password::File(_)), State::Down { retry_at }) =
            (is_refused, &self.options.password, &mut self.state)
        {
            self.refused = self.password.take().map(|password| (password, *retry_at));
            *retry_at = now;
        }
    }

    /// Closes the connection, if any; the next attempt follows after `wait`.
    pub(super) fn close(&mut self, wait: Duration) {
        drop(self.turn_to_next(Some(wait), Instant::now()));
        self.status.left(self.broker().to_string(), SystemTime::now());
    }

    /// Drops the connection; the next attempt, to the next broker, follows after `wait` or as the rotation requires.
    fn turn_to_next(&mut self, wait: Option<Duration>, now: Instant) -> Option<Connection> {
        let held = match &self.state {
            State::Up(_, Phase::Ready { since, .. }) => Some(now.saturating_duration_since(*since)),
            _ => None,
        };
        if held.is_some() || !self.rotation.is_single() {
            // The next broker, or this one with another configuration, may accept a more complete last will.
            self.will = WillForm::first(self.options.retain);
        }
        let usual = self.rotation.next(held.unwrap_or_default());
        let retry_at = now + wait.unwrap_or(usual);
        match std::mem::replace(&mut self.state, State::Down { retry_at }) {
            State::Up(connection, _) => Some(*connection),
            State::Down { .. } | State::Reading(..) => None,
        }
    }
}

/// Reads certificates and password for an attempt, so that renewed ones are used without a restart.
async fn read_credentials(options: Arc<Options>, reads: Arc<Semaphore>) -> Result<Credentials, String> {
    let permit = reads.acquire_owned().await.map_err(|error| error.to_string())?;
    let read = move || {
        let _permit = permit;
        let own = options.identity.as_ref();
        let own = own.map(|(certificate, key)| (certificate.as_path(), key.as_path()));
        let config = options
            .tls
            .then(|| tls::client(options.ca.as_deref(), own))
            .transpose()?;
        let password = options.password.as_ref().map(Password::read).transpose()?;
        Ok((config, password))
    };
    tokio::task::spawn_blocking(read)
        .await
        .map_err(|error| error.to_string())?
}

fn late_files() -> String {
    format!("the files with certificates and password cannot be read: {}", late())
}
