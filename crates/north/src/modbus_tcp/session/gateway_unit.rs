//! Unit 255: the registers of the gateway itself, stop all among them.

use std::time::Instant;

use super::request::registers_written;
use super::{ClientSession, Decision, WRITES};
use crate::command_json::{nothing_to_stop, refuse_stop_all};
use crate::modbus_tcp::frame::Frame;
use crate::modbus_tcp::identify::Identity;
use crate::register_map::{self, BusFigures, FIRST, NOT_STANDING, STOP_ALL};
use drivegate_core::order::Authority;
use drivegate_core::plant::BusHandle;
use drivegate_core::stop_all;
use drivegate_proto::{Exception, Reply, RequestPdu};

impl ClientSession {
    /// Unit 255: the input registers, which can also be read as holding registers, since many clients cannot read
    /// input registers.
    pub(super) fn gateway(&self, frame: &Frame<'_>, now: Instant) -> Result<Decision, Exception> {
        if WRITES.contains(&frame.function) {
            return self.stop_all(frame, now);
        }
        let request = RequestPdu::decode(frame.pdu)?;
        let plant = &self.routes.plant;
        let reply = match request {
            RequestPdu::Read { table, start, count } if !table.is_bits() && start >= FIRST => {
                if (start, count) != (NOT_STANDING, 1) {
                    return Err(Exception::ADDRESS);
                }
                let drives = stop_all::not_standing(self.routes.drives(), now);
                Reply::Registers(vec![u16::try_from(drives).unwrap_or(u16::MAX - 1)])
            }
            RequestPdu::Read { table, start, count } if !table.is_bits() => {
                let bus = |place: usize| self.routes.bus(place).map(figures);
                Reply::Registers(register_map::gateway(start, count, bus)?)
            }
            RequestPdu::DeviceIdentification { code, object } => {
                let identity = Identity {
                    product: "gateway",
                    title: "drivegate",
                    name: &plant.gateway,
                };
                identity.reply(code, object)?
            }
            _ => return Err(Exception::FUNCTION),
        };
        Ok(Decision::Reply(request, reply))
    }

    /// Handles a write to unit 255: 1 at the register that stops all drives that the listener serves. The drives are stopped
    /// whatever else the write covers, and whatever function 23 reads: the rest is answered with 02 after them.
    fn stop_all(&self, frame: &Frame<'_>, now: Instant) -> Result<Decision, Exception> {
        if self.client.rights.authority() != Authority::Write {
            return Err(Exception::FUNCTION);
        }
        let request = RequestPdu::decode(frame.pdu)?;
        let written = registers_written(&request);
        let stops = written.iter().find(|(address, _)| *address == STOP_ALL);
        let (_, value) = *stops.ok_or(Exception::FUNCTION)?;
        if value != 1 {
            return Err(Exception::VALUE);
        }
        let (plant, scope, origin) = (&self.routes.plant, self.routes.scope(), self.client.origin());
        match self.routes.stop_all.order(plant, &scope, &origin, stop_all::WAIT, now) {
            Ok(order) => Ok(Decision::StopAll(request, order.acknowledged)),
            // The client has no right to write here.
            Err(why) => {
                refuse_stop_all(plant, nothing_to_stop(&why), &origin, now);
                Err(Exception::FUNCTION)
            }
        }
    }
}

fn figures(bus: &BusHandle) -> BusFigures {
    let health = bus.image.health();
    BusFigures {
        up: health.up,
        drives: bus.image.drives.len(),
        online: bus.image.online(),
        load: health.load,
        cycle: health.fast.last,
        transactions: bus.image.transactions_total(),
        errors: bus.image.errors_total(),
        queued: bus.queue.lock().writes(),
    }
}
