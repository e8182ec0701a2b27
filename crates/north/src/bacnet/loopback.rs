//! The server without sockets and runtime, for tests in virtual time.

use std::net::SocketAddrV4;
use std::sync::Arc;
use std::time::Instant;

use drivegate_bacnet::To;

use super::Options;
use super::desk::{Desk, Ended};
use super::rights::HostRights;
use super::writes::Waiting;
use drivegate_core::plant::SharedPlant;

/// A server without sockets. Time is an argument.
#[derive(Debug)]
pub struct Loopback {
    desk: Desk,
    waiting: Vec<(u64, Waiting)>,
}

impl Loopback {
    /// A server at the address of `options`, on a network with a mask of 8 bits.
    pub fn new(options: Options, plant: SharedPlant, now: Instant) -> Loopback {
        let (rights, at) = (HostRights::new(&options), (options.listen, 8));
        let mut desk = Desk::new(Arc::new(options), rights, plant, at, now);
        desk.start(now);
        Loopback {
            desk,
            waiting: Vec::new(),
        }
    }

    /// Processes a received datagram. A command in it is in the queue of its bus when this returns.
    pub fn receive(&mut self, from: SocketAddrV4, datagram: &[u8], now: Instant) {
        self.desk.receive(from, datagram, now);
        self.take_up(now);
    }

    /// Sends the clients the results of their completed writes.
    pub fn collect(&mut self, now: Instant) {
        let mut place = 0;
        while let Some((_, waiting)) = self.waiting.get_mut(place) {
            match waiting.placed.answer() {
                None => place += 1,
                Some(answer) => {
                    let (token, waiting) = self.waiting.remove(place);
                    self.desk.ended(&Ended::of(token, waiting, answer.outcome), now);
                }
            }
        }
        self.take_up(now);
    }

    /// Does all that is due; the caller repeats this ten times a second.
    pub fn poll(&mut self, now: Instant) {
        self.desk.poll(now);
        self.take_up(now);
    }

    fn take_up(&mut self, now: Instant) {
        while let Some(order) = self.desk.next_order(now) {
            self.waiting.push(order);
        }
    }

    /// The next datagram that the server sends.
    pub fn transmit(&mut self) -> Option<(To, Vec<u8>)> {
        self.desk.server.transmit()
    }
}
