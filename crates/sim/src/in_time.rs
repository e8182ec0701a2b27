//! A simulated drive in virtual time, for the tests of the models.

use std::time::Duration;

use super::SimTime;
use super::model::Model;
use drivegate_proto::{Exception, Reply, RequestPdu, Table};

/// A drive together with its clock.
pub(crate) struct InTime<D> {
    pub(crate) drive: D,
    pub(crate) now: SimTime,
}

impl<D: Model> InTime<D> {
    /// A drive that was switched on at the beginning of time.
    pub(crate) fn of(drive: D) -> InTime<D> {
        InTime {
            drive,
            now: SimTime::ZERO,
        }
    }

    pub(crate) fn wait(&mut self, milliseconds: u64) -> &mut InTime<D> {
        self.now += Duration::from_millis(milliseconds);
        self.drive.advance(self.now);
        self
    }

    pub(crate) fn ask(&mut self, request: &RequestPdu) -> Option<Reply> {
        self.drive.answer(request, self.now)
    }

    /// Reads registers of a table.
    pub(crate) fn registers(&mut self, table: Table, start: u16, count: u16) -> Result<Vec<u16>, Exception> {
        match self.ask(&RequestPdu::read(table, start, count)) {
            Some(Reply::Registers(values)) => Ok(values),
            Some(Reply::Exception(exception)) => Err(exception),
            other => panic!("{other:?}"),
        }
    }

    /// Writes to the drive.
    pub(crate) fn written(&mut self, request: &RequestPdu) -> Result<(), Exception> {
        match self.ask(request) {
            Some(Reply::Written) => Ok(()),
            Some(Reply::Exception(exception)) => Err(exception),
            other => panic!("{other:?}"),
        }
    }

    /// Writes one register with function 6, several with function 16.
    pub(crate) fn write(&mut self, start: u16, values: &[u16]) -> Result<(), Exception> {
        self.written(&match values {
            [value] => RequestPdu::write_register(start, *value),
            _ => RequestPdu::write_registers(start, values),
        })
    }
}
