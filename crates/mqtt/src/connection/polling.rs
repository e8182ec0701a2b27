//! The task that polls a connection and reports what happens.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Instant;

use futures_util::FutureExt;
use rumqttc::{
    ConnectReturnCode, ConnectionError, Event, EventLoop, Outgoing, Packet, PubAckReason, SubscribeReasonCode,
};
use tokio::sync::mpsc;

use super::super::broker_limits::{BrokerLimits, Lack};
use super::super::reasons::{is_closed, reason, reference, refusal};
use super::super::request::Incoming;
use super::backlog::Backlog;
use super::{REQUESTS, Step};
use drivegate_core::order::Arrival;
use drivegate_north::reading::Reader;

/// Polls until the first error and reports the events.
pub(super) async fn poll(
    mut eventloop: EventLoop,
    reader: Arc<Reader>,
    event: mpsc::Sender<Step>,
    backlog: Arc<Backlog>,
) {
    let mut accepted = false;
    let mut elsewhere = String::new();
    loop {
        let event_or_end = eventloop.poll().await;
        // Packets are read in batches: the earliest arrival of the batch counts, that of a packet's first part included.
        let arrival = reader.first();
        let item = match event_or_end {
            Ok(Event::Outgoing(Outgoing::Publish(packet))) => {
                backlog.rate().sent(Instant::now());
                backlog.trail().published();
                let left = backlog.messages.fetch_sub(1, Ordering::SeqCst).saturating_sub(1);
                if left <= REQUESTS / 2
                    && backlog.room_wanted.swap(false, Ordering::SeqCst)
                    && event.send(Step::Room).await.is_err()
                {
                    return;
                }
                (packet != 0).then_some(Step::Sent(packet))
            }
            Ok(event) => {
                match &event {
                    Event::Outgoing(Outgoing::Subscribe(_)) => backlog.trail().subscribed(),
                    Event::Outgoing(Outgoing::PingReq) => backlog.trail().pinged(),
                    Event::Incoming(Packet::Disconnect(told)) => elsewhere = reference(told),
                    _ => {}
                }
                interpret(event, arrival)
            }
            Err(ConnectionError::ConnectionRefused(ConnectReturnCode::QoSNotSupported)) => {
                Some(Step::Refuses(Lack::Acknowledgements))
            }
            Err(ConnectionError::ConnectionRefused(ConnectReturnCode::RetainNotSupported)) => {
                Some(Step::Refuses(Lack::Retained))
            }
            Err(error) if accepted && is_closed(&error) => Some(Step::Lost(backlog.closed())),
            Err(error) if accepted => Some(Step::Lost(format!("{}{elsewhere}", reason(&error)))),
            Err(error) => Some(Step::Lost(refusal(&error))),
        };
        let Some(item) = item else { continue };
        accepted |= matches!(item, Step::Accepted(_));
        let end = matches!(item, Step::Lost(_) | Step::Refuses(_));
        let sent = {
            let mut sending = std::pin::pin!(event.send(item));
            match (&mut sending).now_or_never() {
                Some(sent) => sent,
                None => {
                    // Reading pauses until the client has room.
                    reader.ceased();
                    sending.await
                }
            }
        };
        if sent.is_err() || end {
            return;
        }
    }
}

fn interpret(event: Event, arrival: Arrival) -> Option<Step> {
    match event {
        Event::Incoming(Packet::ConnAck(ack)) => Some(Step::Accepted(BrokerLimits::of(&ack))),
        Event::Incoming(Packet::SubAck(ack)) => {
            let refused = |code: &SubscribeReasonCode| match code {
                SubscribeReasonCode::Success(_) => None,
                why => Some(format!("{why:?}")),
            };
            Some(Step::Subscribed(ack.return_codes.iter().map(refused).collect()))
        }
        Event::Incoming(Packet::PubAck(ack)) => Some(match ack.reason {
            PubAckReason::Success | PubAckReason::NoMatchingSubscribers => Step::Acked(ack.pkid),
            why => Step::Refused(ack.pkid, why),
        }),
        Event::Incoming(Packet::Publish(publish)) => {
            Incoming::of(publish, arrival).map(|message| Step::Message(Box::new(message)))
        }
        Event::Incoming(_) => Some(Step::Nothing),
        // A packet id would have been used again before its acknowledgement.
        Event::Outgoing(Outgoing::AwaitAck(_)) => Some(Step::Stuck("the broker did not acknowledge a message")),
        Event::Outgoing(Outgoing::PingReq) => Some(Step::Pinged),
        Event::Outgoing(_) | Event::Auth(_) => None,
    }
}
