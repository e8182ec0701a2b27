//! A vendor's tool at the slot of a bus that the gateway polls at full load: every answer is right and belongs to the request that
//! the tool made last, process data keeps its rate, and a stop waits for the exchange on the line at most.
//!
//! `WORLD_TOOL=n` makes n requests on each line instead of the few of every test run.

use std::sync::Arc;
use std::time::{Duration, Instant};

use drivegate_core::order::Urgency;
use drivegate_core::process_image::Access;
use drivegate_model::drive::{DriveIndex, ModelPoint};
use drivegate_north::slot::{Loopback, Slot, SlotAccess};
use drivegate_north::{NorthState, SlotOutcome};
use drivegate_proto::{LineFormat, Protocol, RequestPdu, Table};
use drivegate_sim::random::Random;
use drivegate_sim::simulated_drive::{DriveOptions, ModelOptions};

mod order;

use super::bus::{Asked, Parts, Seen};
use super::rig::{Rig, line, write};
use super::scenario::Line;

/// Requests on each line of every test run.
const REQUESTS: u64 = 400;
/// Time after which a tool gives up its request.
const TIMEOUT: Duration = Duration::from_millis(1100);
/// Time within which the gateway answers a tool, or not at all.
const ANSWER_WITHIN: Duration = Duration::from_secs(1);

fn requests() -> u64 {
    std::env::var("WORLD_TOOL").map_or(REQUESTS, |text| text.parse().expect("a number"))
}

/// A request of a tool that waits for its answer.
#[derive(Debug, Clone)]
struct Question {
    address: u8,
    pdu: RequestPdu,
    at: Instant,
    patience: Duration,
    /// Answers of the drive to the request, one for each time that the request was on the line.
    said: Vec<Vec<u8>>,
}

#[derive(Debug, Default, Clone, Copy)]
struct Figures {
    asked: u64,
    answered: u64,
    refused: u64,
    given_up: u64,
}

/// A tool that behaves like a program: it sends a request, waits, thinks, and sends the next.
struct ToolRig {
    rig: Rig,
    slot: Loopback,
    stats: Arc<NorthState>,
    dice: Random,
    question: Option<Question>,
    next: Instant,
    /// Chooses the next request: address and PDU.
    asks: fn(&mut Random, &Line) -> (u8, RequestPdu),
    /// Share of requests that the tool gives up after a few ms.
    impatient: f64,
    heard: Vec<u8>,
    figures: Figures,
    /// The line, on which every request must have a cause.
    line: Line,
}

fn slot(line: &Line, access: SlotAccess) -> Slot {
    Slot {
        bus: "line0".to_string(),
        protocol: line.protocol,
        format: LineFormat::new(line.baud, line.format).unwrap(),
        listen: None,
        rfc2217: None,
        pty: None,
        access,
        allow: Vec::new(),
        idle_timeout: None,
    }
}

impl ToolRig {
    fn new(line: Line, access: SlotAccess, seed: u64) -> ToolRig {
        let parts = Parts::of(0, &line, seed);
        ToolRig::with(line, parts, access, seed)
    }

    fn with(line: Line, parts: Parts, access: SlotAccess, seed: u64) -> ToolRig {
        let mut rig = Rig::new(&line, parts);
        rig.until("all drives are read", Duration::from_secs(600), Rig::is_whole);
        let stats: Arc<NorthState> = Arc::default();
        let slot = Loopback::new(slot(&line, access), rig.shared_plant(), stats.clone(), "tool");
        ToolRig {
            next: rig.now,
            rig,
            slot,
            stats,
            dice: Random::new(seed),
            question: None,
            asks: reads,
            impatient: 0.0,
            heard: Vec::new(),
            figures: Figures::default(),
            line,
        }
    }

    /// Runs until the tool has made this number of further requests.
    fn ask(&mut self, requests: u64) {
        let until = self.figures.asked + requests;
        while self.figures.asked < until || self.question.is_some() {
            self.step(self.figures.asked < until);
        }
    }

    /// Runs the next event on the line, at the slot, or in the tool.
    fn step(&mut self, asks: bool) -> Vec<Seen> {
        let gives_up = self.question.as_ref().map(|question| question.at + question.patience);
        let asks_at = (self.question.is_none() && asks).then_some(self.next);
        let due = [gives_up, asks_at, self.slot.wake_at()].into_iter().flatten().min();
        let until = due
            .unwrap_or(self.rig.now + Duration::from_millis(100))
            .max(self.rig.now);
        let seen = self.rig.step(until).unwrap_or_default();
        for one in &seen {
            if let Seen::Acted(asked) = one {
                self.acted(asked);
            }
        }
        let now = self.rig.now;
        let answer = self.pass(&[]);
        self.hear(&answer);
        if self
            .question
            .as_ref()
            .is_some_and(|question| now >= question.at + question.patience)
        {
            self.question = None;
            self.figures.given_up += 1;
            self.next = now;
        }
        if self.question.is_none() && asks && now >= self.next {
            self.question_now();
        }
        seen
    }

    /// Gives the slot bytes of the tool, or none, at the present time; returns the answer. The bus is woken if a
    /// request was given to it.
    fn pass(&mut self, bytes: &[u8]) -> Vec<u8> {
        let now = self.rig.now;
        let given = !bytes.is_empty() || self.slot.wake_at().is_some_and(|at| at <= now);
        let answer = self.slot.receive(bytes, now);
        if given {
            self.rig.bus.command_came(now);
        }
        answer
    }

    fn acted(&mut self, asked: &Asked) {
        let address = self
            .rig
            .bus
            .handle
            .image
            .drives
            .get(DriveIndex::new(asked.drive))
            .map(|drive| drive.spec.address);
        let Some(question) = &mut self.question else { return };
        let same = address.is_none_or(|address| address == question.address) && asked.pdu == question.pdu;
        if same && !asked.is_poll && asked.at >= question.at {
            question.said.push(asked.frame.clone());
        }
    }

    fn question_now(&mut self) {
        let (address, pdu) = (self.asks)(&mut self.dice, &self.line);
        let mut frame = Vec::new();
        self.line.protocol.encode(
            &drivegate_proto::Request {
                address,
                pdu: pdu.clone(),
                n2: self.rig.bus.profile.n2,
            },
            &mut frame,
        );
        assert!(!frame.is_empty(), "{pdu:?}");
        let patience = if self.dice.chance(self.impatient) {
            Duration::from_millis(self.dice.within(1..=40))
        } else {
            TIMEOUT
        };
        self.figures.asked += 1;
        let now = self.rig.now;
        self.question = Some(Question {
            address,
            pdu,
            at: now,
            patience,
            said: Vec::new(),
        });
        // Some requests arrive in two pieces, as a serial program writes them.
        let cut = self.dice.within(0..=frame.len() as u64) as usize;
        let early = self.pass(&frame[..cut]);
        assert!(early.is_empty() || cut == frame.len(), "an answer to half a request");
        self.hear(&early);
        let answer = self.pass(&frame[cut..]);
        self.hear(&answer);
    }

    /// Gives the tool bytes, which must be the whole answer to its request.
    fn hear(&mut self, bytes: &[u8]) {
        self.heard.extend_from_slice(bytes);
        if self.heard.is_empty() {
            return;
        }
        let frame = std::mem::take(&mut self.heard);
        let question = self
            .question
            .take()
            .unwrap_or_else(|| panic!("an answer to nothing: {frame:02X?}"));
        let now = self.rig.now;
        assert!(now < question.at + ANSWER_WITHIN, "late: {:?}", now - question.at);
        if question.said.is_empty() {
            assert!(
                self.refuses(&question, &frame),
                "{question:?} was answered {frame:02X?} without the drive"
            );
            self.figures.refused += 1;
        } else {
            // A write may have been answered with these bytes after several exchanges.
            assert!(question.said.contains(&frame), "{question:?} was answered {frame:02X?}");
            self.figures.answered += 1;
        }
        self.next = now + Duration::from_micros(self.dice.within(0..=20_000));
    }

    fn refuses(&self, question: &Question, frame: &[u8]) -> bool {
        match self.line.protocol {
            Protocol::N2 => frame.starts_with(b"N"),
            protocol => protocol
                .open_frame(frame)
                .is_some_and(|(address, pdu)| address == question.address && pdu[0] == question.pdu.function() | 0x80),
        }
    }

    fn count(&self, outcome: SlotOutcome) -> u64 {
        let all = self.stats.slots.requests();
        all.iter()
            .find(|(_, of, _)| *of == outcome)
            .map_or(0, |(_, _, count)| *count)
    }

    /// Fast rounds of process data so far.
    fn rounds(&self) -> u64 {
        self.rig.bus.handle.image.health().fast.rounds
    }
}

fn holding(start: u16, count: u16) -> RequestPdu {
    let table = Table::Holding;
    RequestPdu::Read { table, start, count }
}

/// Reads as a tool makes them: process data, parameters in blocks, what does not exist.
fn reads(dice: &mut Random, line: &Line) -> (u8, RequestPdu) {
    let address = dice.within(1..=u64::from(line.drives)) as u8;
    if line.protocol == Protocol::N2 {
        let number = dice.within(1..=8) as u16;
        let pdu = match dice.within(0..=3) {
            0 => RequestPdu::Read {
                table: Table::Input,
                start: 2 * (number - 1),
                count: 2,
            },
            1 => RequestPdu::Read {
                table: Table::DiscreteInput,
                start: number - 1,
                count: 1,
            },
            2 => RequestPdu::Read {
                table: Table::Coil,
                start: number - 1,
                count: 1,
            },
            _ => RequestPdu::Read {
                table: Table::Holding,
                start: 2 * (number - 1),
                count: 2,
            },
        };
        return (address, pdu);
    }
    let start = match dice.within(0..=4) {
        0 => 2000 + dice.within(0..=2) as u16,
        1 => dice.within(2100..=2110) as u16,
        2 => dice.within(0..=60) as u16,
        3 => dice.within(100..=130) as u16,
        _ => dice.within(0..=60_000) as u16,
    };
    (address, holding(start, dice.within(1..=4) as u16))
}

/// Reads, references within and beyond the limits, parameters, runs and stops.
fn anything(dice: &mut Random, line: &Line) -> (u8, RequestPdu) {
    let address = dice.within(1..=u64::from(line.drives)) as u8;
    let write = |address: u16, value: u16| RequestPdu::WriteRegister { address, value };
    match dice.within(0..=9) {
        0 => (address, write(2002, dice.within(0..=12_000) as u16)),
        1 => (address, write(2000, dice.within(0..=1) as u16)),
        2 => (address, write(dice.within(90..=120) as u16, dice.within(0..=9) as u16)),
        3 => (
            address,
            RequestPdu::WriteRegisters {
                start: 2001,
                values: vec![0, dice.within(0..=10_000) as u16],
            },
        ),
        _ => reads(dice, line),
    }
}

/// Lines that the gateway's own polls fill.
fn lines() -> Vec<Line> {
    let mut slow = line("vacon-nx", Protocol::ModbusRtu, 9_600, 4);
    slow.slow_cycle = Duration::from_secs(5);
    let mut n2 = line("vacon-nx-n2", Protocol::N2, 9_600, 2);
    n2.slow_cycle = Duration::from_secs(10);
    vec![
        line("vacon-nx", Protocol::ModbusRtu, 38_400, 3),
        slow,
        line("teco-7300pa", Protocol::ModbusAscii, 19_200, 2),
        line("eaton-hvx", Protocol::ModbusRtu, 19_200, 2),
        n2,
    ]
}

#[test]
fn every_answer_is_the_drives_own_and_belongs_to_its_request() {
    for (seed, line) in (1..).zip(lines()) {
        let name = format!("{} {} {}", line.family, line.protocol.name(), line.baud);
        let mut tool = ToolRig::new(line, SlotAccess::Read, seed);
        // By then every register was read at least once.
        tool.rig.run(Duration::from_secs(30));
        let before = tool.rounds();
        tool.rig.run(Duration::from_secs(60));
        let alone = (tool.rounds() - before) as f64 / 60.0;
        let (from, before) = (tool.rig.now, tool.rounds());
        tool.next = from;
        tool.ask(requests());
        let figures = tool.figures;
        let with_tool = (tool.rounds() - before) as f64 / (tool.rig.now - from).as_secs_f64();
        println!(
            "{name}: {figures:?}, {:.1} requests/s, process data at {:.1} % of its rate",
            figures.answered as f64 / (tool.rig.now - from).as_secs_f64(),
            100.0 * with_tool / alone
        );
        assert!(
            with_tool >= 0.8 * alone,
            "{name}: {with_tool:.2} of {alone:.2} rounds/s"
        );
        assert_eq!(figures.refused, 0, "{name}: nothing is refused that reads");
        assert!(figures.answered * 100 >= figures.asked * 99, "{name}: {figures:?}");
    }
}

#[test]
fn no_answer_is_handed_to_another_request_whatever_the_tool_and_the_line_do() {
    for seed in 1..=6 {
        let mut line = line("vacon-nx", Protocol::ModbusRtu, 38_400, 2);
        line.faults = "late=0.03,drop=0.02,corrupt=0.02,double=0.01".to_string();
        let mut tool = ToolRig::new(line, SlotAccess::Read, seed);
        tool.impatient = 0.4;
        tool.ask(requests());
        println!("seed {seed}: {:?}", tool.figures);
        assert!(
            tool.figures.answered > tool.figures.asked / 4 && tool.figures.given_up > 0,
            "{:?}",
            tool.figures
        );
    }
}

#[test]
fn writes_are_those_of_a_client_and_process_data_keeps_its_rate() {
    for (seed, mut line) in (1..).zip(lines()).take(2) {
        line.spec = |spec| {
            spec.limits.insert("speed_reference".to_string(), 0.0..=80.0);
        };
        let mut tool = ToolRig::new(line, SlotAccess::Write, seed);
        tool.asks = anything;
        tool.rig.run(Duration::from_secs(20));
        let (from, before) = (tool.rig.now, tool.rounds());
        let alone = before as f64 / 20.0;
        tool.next = from;
        tool.ask(requests());
        let share = (tool.rounds() - before) as f64 / (tool.rig.now - from).as_secs_f64() / alone;
        println!(
            "seed {seed}: {:?}, process data at {:.1} %",
            tool.figures,
            100.0 * share
        );
        assert!(share >= 0.8, "{share}");
        assert!(tool.figures.refused > 0 && tool.count(SlotOutcome::Refused) > 0);
        for address in 1..=tool.line.drives {
            let reference = tool.rig.word(address, 2002);
            assert!(
                reference <= 8000,
                "a reference beyond the limits reached the drive: {reference}"
            );
        }
    }
}

#[test]
fn a_stop_waits_for_the_exchange_on_the_line_at_most() {
    let mut tool = ToolRig::new(line("vacon-nx", Protocol::ModbusRtu, 19_200, 3), SlotAccess::Read, 7);
    for round in 0..40u64 {
        tool.ask(1 + round % 5);
        let address = 1 + (round % 3) as u8;
        // The stop arrives at different moments of an exchange of the tool.
        tool.next = tool.rig.now;
        for _ in 0..=round % 17 {
            tool.step(true);
        }
        let stop = tool.rig.points(address, &[("run", 0.0)]);
        let _placed = tool.rig.place(address, stop);
        let mut sent = 0;
        loop {
            let seen = tool.step(true);
            let Some(asked) = seen.iter().find_map(|one| match one {
                Seen::Sent(asked) => Some(asked.clone()),
                _ => None,
            }) else {
                continue;
            };
            let is_stop = asked.pdu
                == RequestPdu::WriteRegister {
                    address: 2000,
                    value: 0,
                };
            if is_stop {
                break;
            }
            // An unknown control word is read first.
            let reads_word = asked.pdu == holding(2000, 1) && asked.drive == usize::from(address) - 1;
            sent += u32::from(!reads_word);
            assert_eq!(sent, 0, "{asked:?} went before the stop");
        }
        let turn = tool.rig.bus.core.asked().expect("the stop is on the line");
        assert!(matches!(turn.rank(), Some(Urgency::Stop | Urgency::Command)));
    }
}

#[test]
fn a_tool_that_says_nothing_changes_no_frame() {
    let sent = |with_tool: bool| {
        let line = line("vacon-nx", Protocol::ModbusRtu, 38_400, 3);
        let mut rig = Rig::recorded(&line, Parts::of(0, &line, 3));
        let slot =
            with_tool.then(|| Loopback::new(slot(&line, SlotAccess::Raw), rig.shared_plant(), Arc::default(), "tool"));
        rig.run(Duration::from_secs(10));
        drop(slot);
        let frames = rig.requests();
        let first = frames[0].start;
        frames
            .into_iter()
            .map(|frame| (frame.start - first, frame.bytes))
            .collect::<Vec<_>>()
    };
    assert!(sent(false) == sent(true));
}

#[test]
fn what_a_tool_reads_fills_the_image() {
    // The slow cycle ensures that the gateway does not read the value itself.
    let mut slow = line("vacon-nx", Protocol::ModbusRtu, 38_400, 1);
    slow.slow_cycle = Duration::from_secs(600);
    let mut tool = ToolRig::new(slow, SlotAccess::Read, 1);
    tool.rig.run(Duration::from_secs(5));
    tool.rig.at_the_drive(1, 101, 4_200);
    assert_ne!(
        tool.rig.value(1, "maximum_frequency").map(|value| value.as_f64()),
        Some(42.0)
    );
    tool.asks = |_, _| (1, holding(100, 4));
    tool.ask(1);
    assert_eq!(
        tool.rig.value(1, "maximum_frequency").map(|value| value.as_f64()),
        Some(42.0)
    );
}

#[test]
fn a_stop_of_a_tool_goes_as_a_stop_and_takes_a_held_start_away() {
    let mut tool = ToolRig::new(line("vacon-nx", Protocol::ModbusRtu, 38_400, 1), SlotAccess::Write, 1);
    let set = |value: u16| RequestPdu::WriteRegister { address: 2000, value };
    let frame = |pdu: &RequestPdu| {
        let mut frame = Vec::new();
        Protocol::ModbusRtu.encode(&drivegate_proto::Request::new(1, pdu.clone()), &mut frame);
        frame
    };
    // A reference uses up the share of writes, so the start after it is held.
    let now = tool.rig.now;
    let reference = RequestPdu::WriteRegister {
        address: 2002,
        value: 5000,
    };
    tool.pass(&frame(&reference));
    tool.pass(&frame(&set(1)));
    assert!(tool.slot.is_waiting() && tool.slot.wake_at().is_some_and(|at| at > now));
    // A stop of another client arrives before the delayed start is sent.
    let stop = tool.rig.points(1, &[("run", 0.0)]);
    assert!(tool.rig.ordered(1, stop).is_ok());
    for _ in 0..200 {
        tool.rig.run(Duration::from_millis(10));
        tool.pass(&[]);
    }
    assert_eq!(tool.rig.word(1, 2000), 0, "the start was asked for before the stop");
    assert_eq!(
        tool.rig
            .sample(1, ModelPoint::Running)
            .good()
            .map(|value| value.as_bool()),
        Some(false)
    );
    // A stop of the tool is not held back, whatever the tool wrote before.
    tool.pass(&frame(&set(1)));
    tool.rig.run(Duration::from_millis(200));
    assert_eq!(tool.rig.word(1, 2000), 1);
    tool.pass(&frame(&reference));
    tool.pass(&frame(&set(0)));
    tool.rig.run(Duration::from_millis(40));
    assert_eq!(tool.rig.word(1, 2000), 0, "behind the exchange on the line");
}

#[test]
fn what_cannot_be_checked_needs_raw_and_a_drive_that_may_be_commanded() {
    let mut base = line("vacon-nx", Protocol::ModbusRtu, 38_400, 2);
    let unknown = |address: u8| frame_of(address, &[0x41, 1, 2]);
    let broadcast = frame_of(0, &[6, 0x07, 0xD2, 0x03, 0xE8]);
    let refusal = |frame: &[u8]| Some(frame_of(frame[0], &[frame[1] | 0x80, 1]));
    for access in [SlotAccess::Read, SlotAccess::Write] {
        let mut tool = ToolRig::new(base.clone(), access, 1);
        assert_eq!(tool.exchange(&unknown(1)), refusal(&unknown(1)));
        assert_eq!(tool.exchange(&broadcast), None, "a broadcast is refused by silence");
        assert_eq!(tool.exchange(&frame_of(9, &[6, 0, 0, 0, 1])), refusal(&[9, 6]));
        assert_eq!(tool.rig.word(1, 2002), 0);
        assert_eq!(tool.count(SlotOutcome::Refused), 3);
    }
    let mut tool = ToolRig::new(base.clone(), SlotAccess::Raw, 1);
    // The simulated drive does not know the function either, and answers with its own exception.
    assert_eq!(tool.exchange(&unknown(1)), refusal(&unknown(1)));
    assert_eq!(tool.count(SlotOutcome::Exception), 1);
    assert_eq!(tool.exchange(&broadcast), None);
    assert_eq!((tool.rig.word(1, 2002), tool.rig.word(2, 2002)), (1000, 1000));
    assert_eq!(tool.count(SlotOutcome::Answered), 1);
    // A broadcast that stops is a stop of each drive, too.
    assert!(tool.rig.set(1, &[("run", 1.0)]).is_ok() && tool.rig.set(2, &[("run", 1.0)]).is_ok());
    assert_eq!(tool.exchange(&frame_of(0, &[6, 0x07, 0xD0, 0, 0])), None);
    assert_eq!((tool.rig.word(1, 2000), tool.rig.word(2, 2000)), (0, 0));
    // A drive that is only monitored keeps both out.
    base.spec = |spec| {
        if spec.address == 2 {
            spec.access = Access::Monitor;
        }
    };
    let mut tool = ToolRig::new(base, SlotAccess::Raw, 1);
    assert_eq!(tool.exchange(&unknown(2)), refusal(&unknown(2)));
    assert_eq!(tool.exchange(&broadcast), None);
    assert_eq!((tool.rig.word(1, 2002), tool.count(SlotOutcome::Refused)), (0, 2));
}

#[test]
fn an_address_without_a_configured_drive_is_read_and_confused_with_nobody() {
    let line = line("vacon-nx", Protocol::ModbusRtu, 38_400, 2);
    let mut parts = Parts::of(0, &line, 1);
    let mut model = ModelOptions::by_name(parts.profile.simulator.as_deref().unwrap()).unwrap();
    model.take_turnaround_of_line();
    parts.drives.push(DriveOptions::new(9, model));
    let mut tool = ToolRig::with(line, parts, SlotAccess::Read, 1);
    tool.rig.at_the_drive(9, 101, 4_200);
    tool.asks = |dice, _| (9, holding(dice.within(100..=103) as u16, 1));
    tool.ask(20);
    assert_eq!(tool.figures.answered, 20);
    for address in [1, 2] {
        assert_ne!(
            tool.rig.value(address, "maximum_frequency").map(|value| value.as_f64()),
            Some(42.0)
        );
        assert_eq!(tool.rig.word(address, 101), 5_000);
    }
    // An address without a drive: silence, and the drives keep their cadence.
    let before = tool.rounds();
    let from = tool.rig.now;
    assert_eq!(tool.exchange(&frame_of(77, &[3, 0, 1, 0, 1])), None);
    assert_eq!(tool.count(SlotOutcome::NoAnswer), 1);
    assert!(tool.rounds() - before > ((tool.rig.now - from).as_millis() / 60) as u64);
}

impl ToolRig {
    /// A request, and the answer within two seconds.
    fn exchange(&mut self, frame: &[u8]) -> Option<Vec<u8>> {
        let until = self.rig.now + Duration::from_secs(2);
        let mut answer = self.pass(frame);
        while self.rig.now < until {
            let due = self.slot.wake_at().unwrap_or(until).min(until).max(self.rig.now);
            self.rig.step(due);
            answer.extend(self.pass(&[]));
        }
        (!answer.is_empty()).then_some(answer)
    }
}

fn frame_of(address: u8, pdu: &[u8]) -> Vec<u8> {
    let mut frame = Vec::new();
    Protocol::ModbusRtu.encode_frame(address, pdu, &mut frame);
    frame
}

#[test]
fn orders_of_clients_and_writes_of_a_tool_leave_the_drive_as_the_last_one_says() {
    let mut tool = ToolRig::new(line("vacon-nx", Protocol::ModbusRtu, 38_400, 1), SlotAccess::Write, 5);
    let answer = tool.exchange(&frame_of(1, &[6, 0x07, 0xD2, 0x13, 0x88]));
    assert_eq!(answer, Some(frame_of(1, &[6, 0x07, 0xD2, 0x13, 0x88])));
    assert_eq!(tool.rig.word(1, 2002), 5000);
    assert!(tool.rig.ordered(1, write(2002, 2000)).is_ok());
    assert_eq!(tool.rig.word(1, 2002), 2000);
}
