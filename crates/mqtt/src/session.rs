//! The session of a client with its broker, for both clients: connects and subscribes, gives up unusable
//! connections, follows reloads, and disconnects. The client decides what is published and received.

use std::sync::Arc;
use std::time::{Duration, Instant};

use rumqttc::mqttbytes::v5::Filter;
use tokio::sync::Notify;
use tokio::time::MissedTickBehavior;
use tokio_util::sync::CancellationToken;

use super::broker_limits::BrokerLimits;
use super::connection::Step;
use super::link::{BrokerLink, Due};
use super::request::Incoming;
use drivegate_core::plant::{Plant, SharedPlant};
use drivegate_north::NorthState;

/// Maximum time between two checks of the connection and the plant.
pub(super) const CHECK: Duration = Duration::from_millis(25);
/// Time for the orderly end of a connection.
const LEAVE: Duration = Duration::from_millis(500);
/// Time for the commands that are in progress when a reload ends the client. When the gateway stops they have ended
/// before.
const LAST_COMMANDS: Duration = Duration::from_secs(3);

/// The last will of a connection.
#[derive(Debug)]
pub(super) struct Will {
    pub(super) topic: String,
    pub(super) payload: Vec<u8>,
    pub(super) retain: bool,
}

/// State that both MQTT clients have.
pub(super) struct Common {
    pub(super) link: BrokerLink,
    pub(super) plant: SharedPlant,
    /// The plant that the client observes.
    pub(super) observed: Arc<Plant>,
    pub(super) stats: Arc<NorthState>,
    /// Wakes the client when a drive was updated.
    pub(super) fresh: Arc<Notify>,
    /// When to check the drives, even if none was updated.
    pub(super) look_at: Instant,
}

impl Common {
    pub(super) fn new(link: BrokerLink, plant: SharedPlant, stats: Arc<NorthState>) -> Common {
        Common {
            link,
            observed: plant.load_full(),
            plant,
            stats,
            fresh: Arc::default(),
            look_at: Instant::now(),
        }
    }
}

/// The differences between the two MQTT clients.
pub(super) trait Client {
    fn common(&mut self) -> &mut Common;

    /// The next step of the connection. All other events that the client waits for are handled inside and reported
    /// as [`Step::Nothing`]. Cancel safe.
    async fn next(&mut self) -> Step;

    /// The last will of the next connection.
    async fn will(&mut self) -> Will;

    /// The broker accepted the connection; the subscriptions follow.
    fn accepted(&mut self, _limits: BrokerLimits) {}

    fn filters(&mut self, limits: BrokerLimits) -> Vec<Filter>;

    /// Notes the broker's answer to the subscriptions: for each, in order, the reason if it was refused.
    fn answered(&mut self, refused: &[Option<String>]);

    /// Notes that the client may publish on this connection from now on.
    fn ready(&mut self, limits: BrokerLimits);

    fn on_message(&mut self, message: Incoming);

    /// The result of a message that the broker acknowledges.
    fn on_delivery(&mut self, _step: Step) {}

    /// Whether the last will would be correct if the broker published it now: subscribers consider the client online.
    fn is_alive(&self) -> bool;

    /// Notes that the connection is closed.
    fn down(&mut self);

    /// Follows this plant from now on, which replaces the previous one after a reload.
    fn adopt(&mut self, plant: Arc<Plant>);

    /// Does everything else that is due.
    fn check(&mut self, now: Instant);

    /// Checks the drives that were updated or are due, and sets when to check again.
    fn publish_due(&mut self);

    /// Publishes pending messages, as far as the connection allows.
    fn publish(&mut self);

    /// Whether the client needs to leave this broker, and how long to wait before the next connection.
    fn leaves(&mut self) -> Option<Duration> {
        None
    }

    /// Whether no command is in progress.
    fn is_idle(&self) -> bool;

    /// Publishes the last messages; false if the connection is to be closed without DISCONNECT.
    async fn say_goodbye(&mut self) -> bool;
}

/// Runs a client until `cancel`; [`end`] then ends it.
pub(super) async fn run(client: &mut impl Client, cancel: CancellationToken) {
    let mut checks = tokio::time::interval(CHECK);
    checks.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        let Common { look_at, fresh, .. } = client.common();
        let (look_at, fresh) = ((*look_at).into(), fresh.clone());
        tokio::select! {
            () = cancel.cancelled() => return,
            step = client.next() => apply(client, step),
            () = fresh.notified() => client.publish_due(),
            () = tokio::time::sleep_until(look_at) => client.publish_due(),
            _ = checks.tick() => check(client, Instant::now()).await,
        }
        follow(client).await;
    }
}

/// Leaves the broker if the client needs to; otherwise publishes pending messages.
async fn follow(client: &mut impl Client) {
    if let Some(wait) = client.leaves() {
        leave(client).await;
        client.common().link.close(wait);
        client.down();
    }
    client.publish();
}

async fn check(client: &mut impl Client, now: Instant) {
    follow_plant(client);
    match client.common().link.due(now) {
        Due::Connect => {
            let will = client.will().await;
            client.common().link.connect(will);
        }
        Due::GiveUp(why) => give_up(client, why),
        Due::Nothing => {}
    }
    client.check(now);
    client.publish_due();
}

/// Follows the plant of the last reload.
pub(super) fn follow_plant(client: &mut impl Client) {
    let plant = client.common().plant.load_full();
    if Arc::ptr_eq(&plant, &client.common().observed) {
        return;
    }
    client.adopt(plant);
    if let Some(limits) = client.common().link.limits().filter(|limits| !limits.wildcards) {
        subscribe(client, limits);
    }
}

/// Applies a step of the connection.
pub(super) fn apply(client: &mut impl Client, step: Step) {
    match step {
        Step::Accepted(limits) => {
            client.accepted(limits);
            subscribe(client, limits);
        }
        Step::Subscribe(limits) => subscribe(client, limits),
        Step::Subscribed(refused) => {
            client.answered(&refused);
            if let Some(limits) = client.common().link.become_ready() {
                client.ready(limits);
            }
        }
        Step::Message(message) => client.on_message(*message),
        Step::Stuck(why) => give_up(client, why),
        Step::Lost(why) => lost(client, &why),
        delivery => client.on_delivery(delivery),
    }
}

fn subscribe(client: &mut impl Client, limits: BrokerLimits) {
    let filters = client.filters(limits);
    if !client.common().link.subscribe(filters) {
        give_up(client, "the subscription could not be sent");
    }
}

/// Ends the connection and reports the reason to the broker. If the client is alive, the last will is published, so
/// that subscribers learn that the gateway is offline.
pub(super) fn give_up(client: &mut impl Client, why: &str) {
    let true_now = client.is_alive();
    client.common().link.give_up(why, true_now);
    client.down();
}

fn lost(client: &mut impl Client, why: &str) {
    drop(client.common().link.lost(why));
    client.down();
}

/// Ends a client: first its commands in progress, then the connection.
pub(super) async fn end(client: &mut impl Client) {
    let until = tokio::time::Instant::now() + LAST_COMMANDS;
    client.publish();
    while client.is_alive() && !client.is_idle() {
        tokio::select! {
            step = client.next() => apply(client, step),
            () = tokio::time::sleep_until(until) => break,
        }
        follow(client).await;
    }
    leave(client).await;
}

/// Publishes the last state and disconnects, within half a second; after that time the connection is closed, and the
/// broker publishes the last will.
async fn leave(client: &mut impl Client) {
    let disconnect = async {
        if !client.say_goodbye().await || !client.common().link.disconnect() {
            return;
        }
        // Messages that are on their way from the broker count there as delivered, so they are still received.
        loop {
            match client.common().link.next().await {
                Step::Lost(_) => return,
                Step::Message(message) => client.on_message(*message),
                _ => {}
            }
        }
    };
    if tokio::time::timeout(LEAVE, disconnect).await.is_err() {
        client.common().link.log_timed_out();
    }
}
