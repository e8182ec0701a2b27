//! The blocks from 0x8000 on: reads of the common model, commands, the hold.

use std::time::Instant;

use super::{ClientSession, Decision};
use crate::modbus_tcp::command_words::{LastWord, ListenerUnit};
use crate::modbus_tcp::forwarded_request::{BusWork, ForwardedRequest, common};
use crate::modbus_tcp::frame::Header;
use crate::register_map::{self, CommandWrite, HEARTBEAT, HOLD};
use drivegate_core::order::{Arrival, Order};
use drivegate_core::permit::Verb;
use drivegate_core::plant::DriveHandle;
use drivegate_model::drive::State;
use drivegate_proto::{Exception, Reply, RequestPdu};

impl ClientSession {
    /// Reads from the blocks from 0x8000 on.
    pub(super) fn common(
        &self,
        drive: &DriveHandle,
        request: RequestPdu,
        start: u16,
        count: u16,
        now: Instant,
    ) -> Decision {
        common(drive, &self.client, start, count, now).map_or_else(Decision::from, |words| {
            Decision::Reply(request, Reply::Registers(words))
        })
    }

    /// A write of `value` to the register of the hold, also in one write with the heartbeat.
    fn hold(&self, drive: &DriveHandle, request: RequestPdu, start: u16, value: u16, now: Instant) -> Decision {
        let verb = match value {
            0 => Verb::Release,
            1 => Verb::Take,
            2 => Verb::Break,
            _ => return Exception::VALUE.into(),
        };
        let origin = self.client.origin();
        // Whether the unit meant this drive was checked before.
        let came = (&Arrival::now(now), now);
        match drive.hold(verb, &origin, self.client.rights.authority(), came) {
            Ok(_) => {
                if start == HEARTBEAT {
                    drive.heartbeat(&origin, now);
                }
                Decision::Reply(request, Reply::Written)
            }
            Err(refusal) => refusal.exception().into(),
        }
    }

    /// Calls `update` with the word last written at 0x8100 of this drive, by a request to this unit id.
    pub(super) fn last_word<T>(&self, unit: u8, drive: &DriveHandle, update: impl FnOnce(&mut LastWord) -> T) -> T {
        let listener = self.view.number;
        let unit = ListenerUnit { listener, unit };
        self.state.command_words.update(unit, drive.machine(), update)
    }

    /// Executes a write to the blocks from 0x8000 on, by a client that may write to the drive.
    pub(super) fn command(
        &self,
        header: Header,
        drive: &DriveHandle,
        request: RequestPdu,
        start: u16,
        values: &[u16],
        now: Instant,
    ) -> Decision {
        // The register of the hold may only be written alone: in any other write it is refused like a missing
        // register, after a stop in the write was carried out.
        match (start, values) {
            (HOLD, [value]) | (HEARTBEAT, [_, value]) if drive.has_authority() => {
                return self.hold(drive, request, start, *value, now);
            }
            _ => {}
        }
        let spec = &drive.image.spec;
        let fault = drive.reading(now).state() == Some(State::Fault);
        let write = self.last_word(header.unit, drive, |last| {
            let before = last.context(fault);
            let write = register_map::command(&spec.profile, start, values, before)?;
            let resets = write.refused.is_none() && write.word.is_some_and(|word| before.resets(word));
            write.word.into_iter().for_each(|word| last.write(word));
            Ok((write, resets))
        });
        let mut forwarded = ForwardedRequest::new(header, drive, request.clone());
        let work = match write {
            Ok((
                CommandWrite {
                    points,
                    refused: Some(refusal),
                    ..
                },
                _,
            )) => BusWork::Stop(Order::Points(points), refusal),
            // A heartbeat alone is not a command, so it is answered at once and not audited.
            Ok((CommandWrite { points, .. }, _)) if points.is_empty() => {
                drive.heartbeat(&self.client.origin(), now);
                return Decision::Reply(request, Reply::Written);
            }
            Ok((CommandWrite { points, .. }, resets)) => {
                forwarded.resets = resets;
                BusWork::Order(Order::Points(points))
            }
            Err(refusal) => BusWork::Refused(refusal),
        };
        Decision::Drive(Box::new((forwarded, work)))
    }
}
