//! The actions of the clients in a world.

use super::*;
use drivegate_core::plant::OrderRequest;
use drivegate_model::drive::PointIndex;

/// Additional time that a client waits after an order that was answered at once.
const TURNED_AWAY: Duration = Duration::from_millis(40);

impl World {
    pub(super) fn act(&mut self, index: usize) {
        let now = self.now;
        let habit = self.clients[index].habit;
        let ms = Duration::from_millis;
        let pause = match habit {
            Habit::StopsInALoop => ms(1),
            Habit::Floods | Habit::Duels | Habit::Shares => ms(5),
            Habit::Crowds => ms(3),
            Habit::Steady => ms(500),
            _ if self.dice.chance(0.3) => Duration::ZERO,
            _ => ms(self.dice.within(1..=700)),
        };
        self.clients[index].next = now + pause;
        if now < self.clients[index].silent_until {
            return;
        }
        let falls_silent = match habit {
            // A client that acts this often would otherwise be silent most of the time.
            Habit::StopsInALoop => 0.000_3,
            Habit::Floods if self.scenario.floods => 0.000_3,
            _ => 0.01,
        };
        let always = [
            Habit::Steady,
            Habit::Crowds,
            Habit::Duels,
            Habit::Operates,
            Habit::Shares,
        ];
        if !always.contains(&habit) && self.dice.chance(falls_silent) {
            self.clients[index].silent_until = now + ms(self.dice.within(500..=6_000));
        }
        if pause.is_zero() && self.clients[index].open > 24 {
            self.clients[index].next = now + ms(20);
            return;
        }
        let (bus, drive) = match habit {
            Habit::StopsInALoop | Habit::Floods | Habit::Duels => (0, index % usize::from(self.buses[0].line.drives)),
            Habit::Crowds => (
                0,
                self.dice.within(0..=u64::from(self.buses[0].line.drives) - 1) as usize,
            ),
            Habit::Operates if self.clients[index].burst.2 > 0 => {
                (self.clients[index].burst.0, self.clients[index].burst.1)
            }
            Habit::Shares => {
                let bus = self.buses.len() - 1;
                (
                    bus,
                    self.dice.within(0..=u64::from(self.buses[bus].line.drives) - 1) as usize,
                )
            }
            Habit::Steady => {
                let bus = self.buses.len() - 1;
                (bus, usize::from(self.buses[bus].line.drives) - 1)
            }
            _ => {
                let bus = self.dice.within(0..=self.buses.len() as u64 - 1) as usize;
                (
                    bus,
                    self.dice.within(0..=u64::from(self.buses[bus].line.drives) - 1) as usize,
                )
            }
        };
        match habit {
            Habit::Mqtt => self.by_broker(index, bus, drive),
            Habit::Shares => {
                let last = drive + 1 == usize::from(self.buses[bus].line.drives);
                if self.clients[index].open == 0 && !last {
                    self.write_word(index, bus, drive, 0x8100, 1, Wish::Run);
                }
            }
            Habit::ModbusTcp => self.by_modbus_tcp(index, bus, drive),
            Habit::StopsInALoop => {
                if self.clients[index].open == 0 {
                    self.write_word(index, bus, drive, 0x8100, 0, Wish::Stop);
                }
            }
            Habit::Steady => self.plain(index, bus, drive, Wish::Reference, ms(2_000)),
            Habit::Duels if self.clients[index].open > 1 => {}
            Habit::Duels => {
                let wish = if self.records.len().is_multiple_of(2) {
                    Wish::Run
                } else {
                    Wish::Stop
                };
                self.plain(index, bus, drive, wish, ms(2_000));
            }
            Habit::Operates => self.operate(index, bus, drive),
            // The queue is full, so a refused order now and then is enough.
            Habit::Floods | Habit::Crowds if self.clients[index].open > CAPACITY && self.dice.chance(0.95) => {}
            Habit::Crowds => {
                let wishes = [
                    Wish::RunAtReference,
                    Wish::Run,
                    Wish::Reset,
                    Wish::Reverse,
                    Wish::RawRead,
                    Wish::RawRun,
                ];
                let wish = wishes[self.dice.within(0..=5) as usize];
                let wish = if self.dice.chance(0.02) { Wish::Stop } else { wish };
                self.plain(index, bus, drive, wish, ms(2_000));
            }
            Habit::Floods => {
                let wish = match Wish::of(&mut self.dice) {
                    Wish::RawRead if self.records.len().is_multiple_of(2) => Wish::RawOther,
                    wish => wish,
                };
                self.plain(index, bus, drive, wish, ms(2_000));
            }
            Habit::Plain => {
                let converted = self.dice.chance(0.1);
                let wish = if converted {
                    Wish::Converted
                } else {
                    Wish::of(&mut self.dice)
                };
                // Chosen without random numbers, so that the rest of the world does not change.
                let wish = match wish {
                    Wish::RawRead if self.records.len().is_multiple_of(2) => Wish::RawOther,
                    wish => wish,
                };
                // An order with a short time limit may expire while the bus waits for silence before it.
                let short = ms(self.dice.within(3..=80));
                let expiry = [ms(2_000), ms(2_000), ms(400), short][self.dice.within(0..=3) as usize];
                self.plain(index, bus, drive, wish, expiry);
                if self.dice.chance(0.1) {
                    self.heartbeat(bus, drive);
                }
            }
        }
    }

    /// An order of a burst; after the last one a silence that ends about when the lease does, or long after.
    pub(super) fn operate(&mut self, index: usize, bus: usize, drive: usize) {
        let ms = Duration::from_millis;
        let left = match self.clients[index].burst.2 {
            0 => self.dice.within(1..=6),
            left => left,
        };
        self.clients[index].burst = (bus, drive, left - 1);
        let wish = match self.dice.within(0..=9) {
            0..=3 => Wish::Run,
            4..=5 => Wish::RunAtReference,
            6..=7 => Wish::Reference,
            8 => Wish::Reverse,
            _ => return self.heartbeat(bus, drive),
        };
        self.plain(index, bus, drive, wish, ms(2_000));
        if left == 1 {
            let timeout = self.buses[bus]
                .line
                .supervision
                .as_ref()
                .map_or(ms(1_000), |s| s.timeout);
            let silence = if self.dice.chance(0.7) {
                // The next burst goes to the same drive: the client may be back just in time, or just too late.
                self.clients[index].burst.2 = self.dice.within(1..=3);
                timeout.mul_f64(0.9 + 0.3 * self.dice.unit())
            } else {
                ms(self.dice.within(4_000..=16_000))
            };
            self.clients[index].next = self.now + silence;
        }
    }

    pub(super) fn heartbeat(&mut self, bus: usize, drive: usize) {
        if self.buses[bus].line.supervision.is_some() {
            self.buses[bus].handle.image.drives[drive].renew_lease(self.now);
            self.truths[bus][drive].heard_for_certain(self.now);
            self.buses[bus].command_came(self.now);
            self.note(move || format!("heartbeat for line{bus} drive {}", drive + 1));
        }
    }

    /// Records an order that is given now; returns its number.
    pub(super) fn record(&mut self, client: usize, bus: usize, drive: usize, wish: Wish, expiry: Duration) -> usize {
        let now = self.now;
        let id = self.records.len();
        let before = self.open.get(&(bus, drive)).map_or(0, Vec::len);
        self.records.push(Record {
            client,
            bus,
            drive,
            wish,
            accepted: now,
            expires: now + expiry,
            unique: None,
            place: id + 1,
            earliest: id + 1,
            sent: None,
            answer: None,
            read: None,
            before,
            succeeded: false,
        });
        if wish.is_stop() {
            self.truths[bus][drive].last_stop = Some(id);
        }
        self.note(move || format!("order {id} of client {client}: line{bus} drive {} {wish:?}", drive + 1));
        id
    }

    /// Notes that the order is in the queue, or was answered at once.
    pub(super) fn accepted(&mut self, id: usize, unique: Option<Unique>) {
        let Record {
            bus,
            drive,
            wish,
            expires,
            ..
        } = self.records[id];
        if let Some(unique) = &unique {
            self.truths[bus][drive].uniques.insert(unique.clone(), id);
        }
        self.records[id].unique = unique;
        if self.records[id].answer.is_none() {
            let truth = &mut self.truths[bus][drive];
            if wish.is_stop() {
                truth.may_run = None;
            } else if wish.is_run() {
                truth.may_run = truth.may_run.max(Some(expires));
            }
            self.open.entry((bus, drive)).or_default().push(id);
        }
        self.buses[bus].command_came(self.now);
    }

    /// The order was answered at once, so the client waits a moment.
    fn turned_away(&mut self, client: usize) {
        if !self.scenario.floods {
            self.clients[client].next += TURNED_AWAY;
        }
    }

    pub(super) fn plain(&mut self, client: usize, bus: usize, drive: usize, wish: Wish, expiry: Duration) {
        let profile = self.buses[bus].profile.clone();
        let Some((order, unique)) = order_of(&profile, wish, self.records.len()) else {
            return;
        };
        let id = self.record(client, bus, drive, wish, expiry);
        if let Order::Read(pdu) = &order {
            self.records[id].read = Some((pdu.clone(), None));
        }
        let name = self.buses[bus].handle.image.drives[drive].spec.name.clone();
        let handle = self.plant.load().drive(&name).unwrap();
        let origin = Origin::new(SourceKind::CommandLine, format!("client {client}"));
        let mut placed = handle.place(
            OrderRequest::new(order, origin, Authority::Write).within(expiry),
            self.now,
        );
        self.replaced();
        if let Some(answer) = placed.answer() {
            self.answered(id, answer.outcome.code(), Some(&answer.outcome));
            self.turned_away(client);
        }
        self.accepted(id, unique);
        if let Way::Plain(waiting) = &mut self.clients[client].way {
            let is_read = self.records[id].read.is_some();
            waiting.push(Waiting { id, placed, is_read });
        }
        self.clients[client].open += usize::from(self.records[id].answer.is_none());
    }

    /// Sends a message through the broker, to which the gateway loses its connection now and then.
    pub(super) fn by_broker(&mut self, client: usize, bus: usize, drive: usize) {
        let now = self.now;
        let lost = self.scenario.incidents.is_some() && self.dice.chance(0.02);
        let until = now + Duration::from_millis(self.dice.within(100..=5_000));
        let Way::Mqtt(_, broker) = &mut self.clients[client].way else {
            return;
        };
        match broker.away_until {
            Some(back) if now < back => broker.waiting = (broker.waiting + 1).min(8),
            Some(_) => {
                let (again, waiting) = (broker.resume(), std::mem::take(&mut broker.waiting));
                self.note(move || format!("client {client}: the broker is back"));
                again
                    .into_iter()
                    .for_each(|(id, message)| self.repeat(client, id, message));
                (0..waiting).for_each(|_| self.by_mqtt(client, bus, drive));
            }
            None if lost => {
                broker.lose(now, until);
                self.note(move || format!("client {client}: the broker is away"));
            }
            None => self.by_mqtt(client, bus, drive),
        }
    }

    /// The broker delivers a message again: the repetition is not a new order, unless it is a stop.
    fn repeat(&mut self, client: usize, id: usize, message: Incoming) {
        let Record { bus, drive, wish, .. } = self.records[id];
        let now = self.now;
        self.note(move || format!("order {id} is delivered once more"));
        if wish.is_stop() {
            let truth = &mut self.truths[bus][drive];
            truth.may_run = None;
            truth.last_stop = Some(self.records.len());
            truth.repeated_until = Some(now + LAST_STEPS);
        }
        *self.repeats.entry(id).or_default() += 1;
        if let Way::Mqtt(offline, _) = &mut self.clients[client].way {
            offline.receive(message, now);
        }
        self.collect();
        self.buses[bus].command_came(now);
    }

    pub(super) fn by_mqtt(&mut self, client: usize, bus: usize, drive: usize) {
        for _ in 0..=self.dice.within(0..=1) {
            let wish = loop {
                let wish = Wish::of(&mut self.dice);
                if !matches!(wish, Wish::RawRead | Wish::RawRun | Wish::RawStop | Wish::RawBlock(_)) {
                    break wish;
                }
            };
            let profile = self.buses[bus].profile.clone();
            let Some((Order::Points(points), unique)) = order_of(&profile, wish, self.records.len()) else {
                continue;
            };
            let id = self.record(client, bus, drive, wish, Duration::from_secs(2));
            let field = |(index, value): &(PointIndex, Value)| {
                format!("\"{}\": {value}", profile.points.get(*index).unwrap().name)
            };
            let fields: Vec<String> = points.iter().map(field).collect();
            let name = self.buses[bus].handle.image.drives[drive].spec.name.clone();
            let message = Incoming {
                topic: format!("b/world/drive/{name}/set"),
                payload: format!("{{\"id\": {id}, {}}}", fields.join(", ")).into_bytes(),
                packet: id as u16,
                ..Incoming::default()
            };
            let now = self.now;
            if let Way::Mqtt(offline, broker) = &mut self.clients[client].way {
                broker.deliver(id, &message, now);
                offline.receive(message, now);
            }
            self.clients[client].open += 1;
            self.replaced();
            self.collect_client(client, true);
            self.accepted(id, unique);
        }
    }

    /// Closes a client's connection in the middle of a request and opens it again; complete orders are carried out
    /// in any case.
    fn hang_up(&mut self, client: usize) {
        let now = self.now;
        let Way::ModbusTcp(offline, open, _) = &mut self.clients[client].way else {
            return;
        };
        **offline = offline.beside(address(client as u8, client as u16), None, Authority::Write);
        let given_up = std::mem::take(open);
        self.clients[client].open = 0;
        self.note(move || format!("client {client} hangs up"));
        for id in given_up.into_values() {
            let Record {
                bus, drive, expires, ..
            } = self.records[id];
            self.records[id].answer = Some(("given up".to_string(), now));
            let truth = &mut self.truths[bus][drive];
            truth.repeated_until = truth.repeated_until.max(Some(expires + LAST_STEPS));
            if let Some(open) = self.open.get_mut(&(bus, drive)) {
                open.retain(|open| *open != id);
            }
        }
        self.open.retain(|_, open| !open.is_empty());
    }

    pub(super) fn by_modbus_tcp(&mut self, client: usize, bus: usize, drive: usize) {
        if self.dice.chance(0.03) {
            self.hang_up(client);
        }
        match self.dice.within(0..=5) {
            0 => self.write_word(client, bus, drive, 0x8100, 1, Wish::Run),
            1 | 2 => self.write_word(client, bus, drive, 0x8100, 0, Wish::Stop),
            3 => {
                self.write_word(client, bus, drive, 0x8100, 1, Wish::Run);
                self.write_word(client, bus, drive, 0x8100, 0, Wish::Stop);
            }
            _ => self.heartbeat(bus, drive),
        }
    }

    pub(super) fn write_word(&mut self, client: usize, bus: usize, drive: usize, address: u16, value: u16, wish: Wish) {
        let id = self.record(client, bus, drive, wish, Duration::from_secs(2));
        let unit = self.buses[bus].handle.image.drives[drive].spec.unit;
        let now = self.now;
        let mut bytes = Vec::new();
        if let Way::ModbusTcp(offline, open, transaction) = &mut self.clients[client].way {
            *transaction = transaction.wrapping_add(1);
            open.insert(*transaction, id);
            bytes = offline.receive(&write_frame(*transaction, unit, address, value), now);
        }
        self.clients[client].open += 1;
        self.replaced();
        self.take_answers(client, &bytes);
        if self.records[id].answer.is_some() {
            self.turned_away(client);
        }
        self.accepted(id, None);
    }
}
