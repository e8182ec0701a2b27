//! The actions of the clients in a world with stalls.

use super::*;

impl World {
    pub(super) fn connect(&mut self) {
        let now = self.now;
        self.clients += 1;
        self.connections.push(Connection {
            number: self.clients,
            offline: self.servers.connection(Habit::ModbusTcp, self.clients),
            open: false,
            inbox: VecDeque::new(),
            closed: None,
            rest: None,
            transactions: Vec::new(),
            next: now + Duration::from_millis(1_500),
        });
    }

    /// Runs the next action of a client.
    pub(super) fn act(&mut self, index: usize) {
        let now = self.now;
        if let Some((_, bytes, id)) = self.connections[index].rest.take_if(|(at, ..)| *at <= now) {
            self.promised.complete(id, now);
            self.connections[index].inbox.push_back((now, bytes, Some(id)));
        }
        let connection = &self.connections[index];
        if self.calm || !connection.open || connection.next > now || connection.closed.is_some() {
            return;
        }
        let busy = connection.rest.is_some() || connection.transactions.len() > 3;
        let waits = self.healthy && !connection.transactions.is_empty();
        let pause = if self.chance(0.4) {
            self.ms(1..=60)
        } else {
            self.ms(50..=1_500)
        };
        self.connections[index].next = now + pause;
        if busy || waits {
            return;
        }
        // A client without an answer gives up.
        let gives_up = if self.standing.readers.is_some() { 0.2 } else { 0.03 };
        if !self.healthy && self.chance(gives_up) {
            return self.hang_up(index);
        }
        if !self.healthy && self.chance(0.1) {
            return self.by_name();
        }
        let unit = self.dice.within(1..=u64::from(self.bus.line.drives)) as u8;
        let in_parts = !self.healthy && self.chance(0.15);
        match self.dice.within(0..=9) {
            0..=3 => self.write(index, unit, 0x8100, 1, in_parts),
            4..=6 => self.stop(index, unit, in_parts),
            7 if !self.healthy => {
                self.write(index, unit, 0x8100, 1, false);
                self.write(index, unit, 0x8100, 0, false)
            }
            8 if !self.healthy => self.write(index, unit, 0x8100, 4, in_parts),
            _ => self.write(index, unit, 0x8101, 2_000, in_parts),
        };
    }

    /// Sends a stop. Every third one is a word by which drives of the family stop in another way, with its run bits
    /// set, where there is such a word.
    fn stop(&mut self, index: usize, unit: u8, in_parts: bool) -> usize {
        let number = usize::from(self.number);
        let other = self.bus.profile.control.as_ref().and_then(|control| {
            let kind = (number / 3).checked_rem(control.also_stop.len())?;
            let run = control.each_run().next()?.applied(0);
            let word = control.also_stop[kind].applied(control.always.applied(run));
            Some((control.at.address, word))
        });
        let (register, word) = other
            .filter(|(register, _)| number.is_multiple_of(3) && *register < 0x8000)
            .unwrap_or((0x8100, 0));
        self.write(index, unit, register, word, in_parts)
    }

    /// Sends a request over a connection; the rest of it may come later. Returns the number of its order.
    pub(super) fn write(&mut self, index: usize, unit: u8, register: u16, value: u16, in_parts: bool) -> usize {
        let now = self.now;
        let does = match (register, value) {
            (0x8100, 0) => Does::Stop,
            (0x8100, value) if value & 1 == 1 => Does::Run,
            (0x8000.., _) => Does::Other,
            // Clients write to the drive's own registers only what stops it.
            _ => Does::Stop,
        };
        let drives = self.bus.line.drives;
        let machine = if self.bus.line.swapped { drives + 1 - unit } else { unit };
        let id = self.promised.wants(self.connections[index].number, machine, does, now);
        self.number = self.number.wrapping_add(1);
        let frame = write_frame(self.number, unit, register, value);
        let connection = &mut self.connections[index];
        connection.transactions.push((self.number, id));
        if in_parts {
            let at = self.dice.within(1..=frame.len() as u64 - 1) as usize;
            let later = now + Duration::from_millis(self.dice.within(1..=1_200));
            let connection = &mut self.connections[index];
            connection.inbox.push_back((now, frame[..at].to_vec(), None));
            connection.rest = Some((later, frame[at..].to_vec(), id));
            self.wants_reload |= self.reloads && self.dice.chance(0.6);
        } else {
            connection.inbox.push_back((now, frame, Some(id)));
        }
        self.note(move || {
            format!("order {id}: {does:?} of machine {machine} by 0x{register:04X} = {value} of unit {unit}")
        });
        id
    }

    /// Closes a client's connection and opens another one.
    pub(super) fn hang_up(&mut self, index: usize) {
        let connection = &mut self.connections[index];
        connection.closed = Some(self.now);
        if let Some((_, _, id)) = connection.rest.take() {
            self.promised.never_sent(id);
        }
        for (_, id) in &connection.transactions {
            self.promised.closed(*id, self.now);
        }
        self.note(move || format!("the client of connection {index} hangs up"));
        self.connect();
    }

    /// An order by name that starts nothing.
    fn by_name(&mut self) {
        let now = self.now;
        let name = format!("d0-{}", self.dice.within(1..=u64::from(self.bus.line.drives)));
        let (point, value) = match self.dice.within(0..=2) {
            0 => (ModelPoint::Reverse, Value::Bool(self.dice.chance(0.5))),
            1 => (ModelPoint::FaultReset, Value::Bool(true)),
            _ => (
                ModelPoint::SpeedReference,
                Value::Number(self.dice.within(5..=60) as f64),
            ),
        };
        // A program on this machine stalls together with the whole process, or not at all.
        let Some(index) = self
            .bus
            .profile
            .model_index(point)
            .filter(|_| self.standing.readers.is_none())
        else {
            return;
        };
        let origin = Origin::new(SourceKind::CommandLine, "panel");
        let drive = self.plant.load().drive(&name).unwrap();
        let order = Order::Points(vec![(index, value)]);
        self.placed
            .push(drive.place(OrderRequest::new(order, origin, Authority::Write), now));
        self.bus.command_came(now);
        self.note(move || format!("{} = {value} of {name}", point.name()));
    }
}
