use std::time::{Duration, Instant, SystemTime};

use drivegate_testkit::{STALE_AFTER, controlled, profile};

use super::*;
use drivegate_core::process_image::{DriveImage, Link, Snapshot};
use drivegate_model::drive::{PointIndex, Profile};
use drivegate_proto::Table;

fn nx() -> Profile {
    Profile::clone(&profile("vacon-nx"))
}

fn image(profile: Profile) -> DriveImage {
    DriveImage::new(controlled("pump-1", "line1", 1, &profile.into()), STALE_AFTER)
}

/// A drive that runs at half speed, all classes read at `now`.
fn running(now: Instant) -> DriveImage {
    let image = image(nx());
    image.update(|s| {
        s.link = Link::Online(SystemTime::now());
        s.fast_at = Some(now);
        // Status: ready, running, at reference; fieldbus control; then figures; voltage 230.1 V, fault 0.
        let fast = [0x0023, 0x2000, 5000, 2500, 1440, 123, 455, 387, 2301, 540, 0];
        s.store(Table::Holding, 2100, &fast, now);
        s.store(Table::Holding, 7, &[42, 30], now);
        s.store(Table::Holding, 2000, &[0x0001, 0, 5000], now);
        // 0 to 50 Hz.
        s.store(Table::Holding, 100, &[0, 5000, 30, 30], now);
    });
    image
}

fn read(image: &DriveImage, now: Instant, start: u16, count: u16) -> Result<Vec<u16>, Exception> {
    DriveView::new(&image.reading(now, STALE_AFTER), BusState::Up).registers(start, count)
}

#[test]
fn every_register_of_a_running_drive() {
    let now = Instant::now();
    let later = now + Duration::from_millis(250);
    let words = read(&running(now), later, 0x8000, 19).unwrap();
    let wanted = [
        0x80A3, // ready, running, at_reference, remote, online
        3,      // running
        250,    // ms
        0,      // fault_code
        5000,   // 50.00 %
        2500,   // 25.00 Hz
        1440,   // rpm
        123,    // 12.3 A
        455,    // 45.5 %
        387,    // 38.7 %
        2301,   // 230.1 V
        540,    // V
        420,    // 42.0 °C
        0xFFFF, 0xFFFF, // the family has no energy
        0xFFFF, 0xFFFF, // nor operating hours
        5000,   // speed_reference 50.00 %
        2500,   // frequency_reference 25.00 Hz
    ];
    assert_eq!(words, wanted);
    assert_eq!(read(&running(now), later, 0x8100, 4), Ok(vec![1, 5000, 2500, 0]));
    let floats = read(&running(now), later, 0x8200, 26).unwrap();
    let floats: Vec<f32> = floats
        .chunks_exact(2)
        .map(|w| f32::from_bits(u32::from(w[0]) << 16 | u32::from(w[1])))
        .collect();
    assert_eq!(floats[..9], [50.0, 25.0, 1440.0, 12.3, 45.5, 38.7, 230.1, 540.0, 42.0]);
    assert!(floats[9].is_nan() && floats[10].is_nan());
    assert_eq!(floats[11..], [50.0, 25.0]);
}

#[test]
fn every_part_of_a_block_is_the_same_as_in_the_whole() {
    let now = Instant::now();
    let image = running(now);
    for (start, count) in [(0x8000, 19), (0x8100, 4), (0x8200, 26)] {
        let whole = read(&image, now, start, count).unwrap();
        for from in 0..count {
            for to in from + 1..=count {
                let part = read(&image, now, start + from, to - from).unwrap();
                assert_eq!(
                    part,
                    whole[usize::from(from)..usize::from(to)],
                    "{start:04X}+{from}..{to}"
                );
            }
        }
    }
}

#[test]
fn spans_that_leave_a_block() {
    let now = Instant::now();
    let image = running(now);
    let beyond = [
        (0x7FFF, 2),
        (0x8014, 2),
        (0x8015, 1),
        (0x80FF, 1),
        (0x80FF, 2),
        (0x8103, 2),
        (0x8104, 1),
        (0x81FF, 2),
        (0x8219, 2),
        (0x821A, 1),
        (0xFFFF, 1),
        (0x8000, 125),
        (0xFFFF, 125),
    ];
    for (start, count) in beyond {
        assert_eq!(
            read(&image, now, start, count),
            Err(Exception::ADDRESS),
            "{start:04X}+{count}"
        );
    }
}

#[test]
fn a_stale_drive_has_status_and_age_but_no_values() {
    let now = Instant::now();
    let late = now + Duration::from_millis(1001);
    let image = running(now);
    let nothing = |words: &[u16], status, age| {
        assert_eq!(words[..3], [status, 0, age]);
        for (entry, _) in COMMON[3..].iter().zip(0..) {
            let at = usize::from(entry.address - 0x8000);
            let none: &[u16] = match entry.form {
                Form::I16 => &[0x8000],
                Form::U16 => &[0xFFFF],
                _ => &[0xFFFF, 0xFFFF],
            };
            assert_eq!(&words[at..at + none.len()], none, "{entry:?}");
        }
    };
    // The drive still counts as online, but its values are stale.
    nothing(&read(&image, late, 0x8000, 21).unwrap(), ONLINE | STALE, 1001);
    assert_eq!(read(&image, late, 0x8100, 4), Ok(vec![0xFFFF, 0x8000, 0xFFFF, 0]));
    let floats = read(&image, late, 0x8200, 26).unwrap();
    assert!(floats.chunks(2).all(|w| w == [0x7FC0, 0]), "{floats:04X?}");

    let reading = image.reading(now, STALE_AFTER);
    nothing(
        &DriveView::new(&reading, BusState::Down).registers(0x8000, 21).unwrap(),
        STALE,
        0,
    );

    image.update(|s| s.link = Link::Offline(SystemTime::now()));
    nothing(&read(&image, now, 0x8000, 21).unwrap(), STALE, 0);
    let days = now + Duration::from_secs(200_000);
    nothing(&read(&image, days, 0x8000, 21).unwrap(), STALE, 65_534);
    nothing(
        &read(&super::tests::image(nx()), now, 0x8000, 21).unwrap(),
        STALE,
        0xFFFF,
    );
}

#[test]
fn states_and_status_bits() {
    let now = Instant::now();
    let image = running(now);
    for (status_word, status, state) in [
        (0x0000, 0x8080, 1),
        (0x0001, 0x8081, 2),
        (0x0003, 0x8083, 3),
        (0x0007, 0x8087, 3),
        (0x0018, 0x8098, 4),
        (0x0040, 0x80C0, 1),
    ] {
        image.update(|s| s.store(Table::Holding, 2100, &[status_word], now));
        assert_eq!(
            read(&image, now, 0x8000, 2),
            Ok(vec![status, state]),
            "{status_word:04X}"
        );
    }
    image.update(|s| s.store(Table::Holding, 2110, &[53], now));
    assert_eq!(read(&image, now, 0x8003, 1), Ok(vec![53]));
    image.update(|s| s.store(Table::Holding, 2000, &[0x0003, 0, 0xEC78], now));
    assert_eq!(
        read(&image, now, 0x8100, 3),
        Ok(vec![3, 0xEC78, 0xFFFF]),
        "-50 % of 0 to 50 Hz is below 0 Hz, which 0x8102 cannot say"
    );
    assert_eq!(read(&image, now, 0x8012, 1), Ok(vec![(-2500i16) as u16]));
}

/// An unknown bit is neither set nor clear: the word is stale, the state not available.
#[test]
fn bits_that_are_not_known() {
    let now = Instant::now();
    let cx = Profile::clone(&profile("vacon-cx"));
    let image = image(cx);
    image.update(|s| {
        (s.link, s.fast_at) = (Link::Online(SystemTime::now()), Some(now));
        for (address, bit) in [(0, 1), (1, 1), (2, 1), (3, 0), (4, 0)] {
            s.store(Table::DiscreteInput, address, &[bit], now);
        }
        s.store(Table::Input, 0, &[2500], now);
        s.store(Table::Holding, 0, &[2500], now);
        s.store(Table::Coil, 0, &[1], now);
        s.store(Table::Coil, 1, &[0], now);
    });
    // Ready, running, at reference, remote; the family has no warning.
    let all = 0x80A3;
    assert_eq!(read(&image, now, 0x8000, 2), Ok(vec![all, 3]));
    assert_eq!(read(&image, now, 0x8100, 1), Ok(vec![1]));
    let without = |address, status, state| {
        let known = image.snapshot();
        image.update(|s| s.refuse(Table::DiscreteInput, address, 1, Exception::ADDRESS));
        assert_eq!(
            read(&image, now, 0x8000, 2),
            Ok(vec![status, state]),
            "discrete input {address}"
        );
        image.update(|s| *s = Snapshot::clone(&known));
    };
    without(2, all & !0x0002 | STALE, 0xFFFF);
    without(4, all | STALE, 0xFFFF);
    without(3, all | STALE, 3);
    without(0, all & !0x0080 | STALE, 3);
    image.update(|s| s.refuse(Table::Coil, 1, 1, Exception::ADDRESS));
    assert_eq!(
        read(&image, now, 0x8100, 1),
        Ok(vec![0xFFFF]),
        "it may be commanded to reverse"
    );
    assert_eq!(read(&image, now, 0x8000, 2), Ok(vec![all, 3]));
}

#[test]
fn a_refused_point_is_not_available() {
    let now = Instant::now();
    let image = running(now);
    image.update(|s| s.refuse(Table::Holding, 7, 1, Exception::ADDRESS));
    assert_eq!(read(&image, now, 0x800B, 2), Ok(vec![540, 0x8000]));
    image.update(|s| s.refuse(Table::Holding, 2000, 3, Exception::ADDRESS));
    assert_eq!(read(&image, now, 0x8100, 3), Ok(vec![0xFFFF, 0x8000, 0xFFFF]));
}

#[test]
fn values_out_of_range_are_not_available() {
    let one = |form: Form, value: f64, per_unit| form.registers_of(Some(value), per_unit)[0];
    assert_eq!(one(Form::I16, 327.67, 100.0), 32_767);
    assert_eq!(one(Form::I16, 327.68, 100.0), NO_I16);
    assert_eq!(one(Form::I16, -327.67, 100.0), 0x8001);
    assert_eq!(one(Form::I16, -327.68, 100.0), NO_I16);
    assert_eq!(one(Form::U16, 6553.4, 10.0), 65_534);
    assert_eq!(one(Form::U16, 6553.5, 10.0), NO_U16);
    assert_eq!(one(Form::U16, -1.0, 1.0), NO_U16);
    assert_eq!(one(Form::U16, -0.4, 1.0), 0);
    assert_eq!(one(Form::I16, 0.285, 100.0), 29, "28.499999999999996 is dust");
    assert_eq!(one(Form::I16, f64::NAN, 1.0), NO_I16);
    assert_eq!(Form::U32.registers_of(Some(4_294_967_294.0), 1.0), [0xFFFF, 0xFFFE]);
    assert_eq!(Form::U32.registers_of(Some(4_294_967_295.0), 1.0), [0xFFFF, 0xFFFF]);
    assert_eq!(
        Form::U32.registers_of(Some(70_000.0), 1.0),
        [1, 4464],
        "high word first"
    );
    assert_eq!(Form::F32.registers_of(Some(1e300), 1.0), [0x7FC0, 0]);
}

/// A motor current beyond 3276.7 A: a user profile with a coarser scale.
#[test]
fn a_large_drive_reads_as_float() {
    let now = Instant::now();
    let mut profile = nx();
    let current = profile.model_index(ModelPoint::MotorCurrent).unwrap();
    let drivegate_model::drive::Source::Raw(raw) = &mut profile.points.get_mut(current).unwrap().source else {
        panic!("motor_current is raw");
    };
    raw.scale = 1.0;
    let image = image(profile);
    image.update(|s| {
        s.link = Link::Online(SystemTime::now());
        s.fast_at = Some(now);
        s.store(Table::Holding, 2105, &[4000], now);
    });
    assert_eq!(read(&image, now, 0x8007, 1), Ok(vec![0x8000]));
    assert_eq!(read(&image, now, 0x8206, 2), Ok(high_low(4000f32.to_bits()).to_vec()));
}

fn named(profile: &Profile, write: &CommandWrite) -> Vec<String> {
    let one = |(i, v): &(PointIndex, Value)| format!("{}={v}", profile.points.get(*i).unwrap().name);
    write.points.iter().map(one).collect()
}

#[test]
fn command_writes() {
    let profile = nx();
    let table: &[(u16, &[u16], u16, &str)] = &[
        (0x8100, &[0], 0, "run=false reverse=false"),
        (0x8100, &[1], 0, "run=true reverse=false"),
        (0x8100, &[3], 0, "run=true reverse=true"),
        (0x8100, &[4], 0, "run=false reverse=false fault_reset=true"),
        (0x8100, &[4], 4, "run=false reverse=false"),
        (0x8100, &[5], 1, "run=true reverse=false fault_reset=true"),
        (0x8101, &[5000], 0, "speed_reference=50"),
        (0x8101, &[0xEC78], 0, "speed_reference=-50"),
        (0x8102, &[2575], 0, "frequency_reference=25.75"),
        (0x8100, &[1, 5000], 0, "run=true reverse=false speed_reference=50"),
        (
            0x8100,
            &[1, 5000, 0xFFFF],
            0,
            "run=true reverse=false speed_reference=50",
        ),
        (
            0x8100,
            &[1, 0x8000, 2500, 7],
            0,
            "run=true reverse=false frequency_reference=25",
        ),
        (0x8100, &[0, 0x8000, 0xFFFF], 0, "run=false reverse=false"),
        (0x8101, &[0x8000, 2500], 0, "frequency_reference=25"),
        (0x8101, &[0x8000, 0xFFFF, 1], 0, ""),
        (0x8102, &[2500, 1], 0, "frequency_reference=25"),
        (0x8103, &[0], 0, ""),
    ];
    for (start, values, last, wanted) in table {
        let write = command(&profile, *start, values, before(*last, false)).unwrap();
        assert_eq!(named(&profile, &write).join(" "), *wanted, "{start:04X} {values:04X?}");
        let covers = |a: u16| *start <= a && usize::from(a - start) < values.len();
        assert_eq!(write.heartbeat, covers(0x8103), "{start:04X} {values:04X?}");
        assert_eq!(write.word, covers(0x8100).then(|| values[0]));
    }
}

fn before(word: u16, fault: bool) -> CommandContext {
    let word = Some(word);
    CommandContext { word, fault }
}

#[test]
fn fault_resets() {
    for (word, last, fault, resets) in [
        (4, 0, false, true),
        (4, 0, true, true),
        (4, 4, false, false),
        (4, 4, true, true),
        (6, 4, true, true),
        (5, 1, true, true),
        (5, 4, true, false),
        (5, 5, true, false),
        (0, 0, true, false),
        (1, 4, true, false),
    ] {
        assert_eq!(
            before(last, fault).resets(word),
            resets,
            "{last} then {word}, fault {fault}"
        );
    }
    // The first word since the start: with run set, it may be a repetition by a client that has been writing it for hours.
    for (word, fault, resets) in [
        (4, false, true),
        (4, true, true),
        (5, true, false),
        (7, true, false),
        (1, true, false),
    ] {
        assert_eq!(
            CommandContext { word: None, fault }.resets(word),
            resets,
            "{word} first, fault {fault}"
        );
    }
}

#[test]
fn refused_command_writes() {
    let mut lacking = nx();
    for point in [
        ModelPoint::Reverse,
        ModelPoint::FaultReset,
        ModelPoint::FrequencyReference,
    ] {
        let index = lacking.model_index(point).unwrap();
        lacking.points.get_mut(index).unwrap().write = false;
    }
    let (address, value) = (Exception::ADDRESS, Exception::VALUE);
    let table: &[(&Profile, u16, &[u16], Exception)] = &[
        (&nx(), 0x8000, &[1], address),
        (&nx(), 0x8012, &[1], address),
        (&nx(), 0x80FF, &[0, 1], address),
        (&nx(), 0x8103, &[1, 1], address),
        (&nx(), 0x8104, &[1], address),
        (&nx(), 0x8200, &[1, 1], address),
        (&nx(), 0xFFFF, &[1, 1], address),
        (&nx(), 0x8100, &[8], value),
        (&nx(), 0x8100, &[0x8000, 0x8000], value),
        (&nx(), 0x8100, &[0xFFFF, 0x8000, 0xFFFF, 0], value),
        (&nx(), 0x8101, &[0x8000], value),
        (&nx(), 0x8102, &[0xFFFF], value),
        (&nx(), 0x8100, &[1, 0x8000], value),
        (&nx(), 0x8101, &[0x8000, 0xFFFF], value),
        (&nx(), 0x8101, &[5000, 2500], value),
        (&lacking, 0x8100, &[3], value),
        (&lacking, 0x8102, &[2500], address),
        // Both the address and the value are wrong: the error reports the address.
        (&lacking, 0x8100, &[9, 100, 2500], address),
    ];
    for (profile, start, values, wanted) in table {
        let refusal = command(profile, *start, values, CommandContext::default()).unwrap_err();
        assert_eq!(refusal.exception(), *wanted, "{start:04X} {values:04X?}: {refusal}");
    }
    let word = command(&lacking, 0x8100, &[1, 5000, 0xFFFF], CommandContext::default()).unwrap();
    assert_eq!(named(&lacking, &word), ["run=true", "speed_reference=50"]);
}

#[test]
fn a_word_without_run_stops_whatever_is_wrong_with_the_rest() {
    let mut lacking = nx();
    for point in [ModelPoint::Reverse, ModelPoint::FrequencyReference] {
        let index = lacking.model_index(point).unwrap();
        lacking.points.get_mut(index).unwrap().write = false;
    }
    let (address, value) = (Exception::ADDRESS, Exception::VALUE);
    let table: &[(&Profile, u16, &[u16], Exception, &str)] = &[
        (&nx(), 0x8100, &[0, 0x8000], value, "run=false reverse=false"),
        (&nx(), 0x8100, &[0, 5000, 2500], value, "run=false reverse=false"),
        (&nx(), 0x8100, &[0, 0, 0, 0, 0], address, "run=false reverse=false"),
        (&nx(), 0x80FF, &[9, 0], address, "run=false reverse=false"),
        (&lacking, 0x8100, &[2], value, "run=false"),
        (&lacking, 0x8100, &[0, 0x8000, 2500], address, "run=false"),
    ];
    for (profile, start, values, exception, points) in table {
        let write = command(profile, *start, values, before(4, false)).unwrap();
        assert_eq!(named(profile, &write).join(" "), *points, "{start:04X} {values:04X?}");
        assert_eq!(
            write.refused.unwrap().exception(),
            *exception,
            "{start:04X} {values:04X?}"
        );
    }
    // A refused reset does not count as a reset: the next one is a change of the bit again.
    let words = |last, word| {
        command(&nx(), 0x8100, &[word, 0x8000], before(last, false))
            .unwrap()
            .word
    };
    assert_eq!((words(0, 4), words(4, 4), words(4, 0)), (Some(0), Some(4), Some(0)));
}

#[test]
fn the_gateway_itself() {
    let bus = |place| {
        (place < 2).then_some(BusFigures {
            up: place == 0,
            drives: 3,
            online: 2,
            load: Some(0.9876),
            cycle: (place == 0).then_some(Duration::from_micros(70_123)),
            transactions: 0x1_0002_0003,
            errors: 5,
            queued: 7,
        })
    };
    let up = [1, 3, 2, 988, 0, 70, 2, 3, 0, 5, 7, 0, 0, 0, 0, 0];
    let down = [0, 3, 0, 0, 0xFFFF, 0xFFFF, 2, 3, 0, 5, 7, 0, 0, 0, 0, 0];
    let all: Vec<u16> = up.into_iter().chain(down).collect();
    assert_eq!(gateway(0, 32, bus), Ok(all.clone()));
    assert_eq!(gateway(14, 4, bus), Ok(all[14..18].to_vec()));
    assert_eq!(gateway(31, 1, bus), Ok(vec![0]));
    let opened = |place| bus(place).map(|figures| BusFigures { load: None, ..figures });
    assert_eq!(gateway(3, 1, opened), Ok(vec![0xFFFF]), "not known in the first second");
    assert_eq!(gateway(19, 1, opened), Ok(vec![0]), "a bus that is down has none");
    for (start, count) in [(31, 2), (32, 1), (0x8000, 1), (65_535, 1)] {
        assert_eq!(gateway(start, count, bus), Err(Exception::ADDRESS), "{start}+{count}");
    }
    let registers: u16 = BUS_REGISTERS.iter().map(|r| r.form.registers()).sum();
    assert_eq!(registers, 11);
    assert!(
        BUS_REGISTERS
            .windows(2)
            .all(|w| w[0].offset + w[0].form.registers() == w[1].offset)
    );
}

#[test]
fn blocks_have_no_gap() {
    for block in BLOCKS {
        for pair in block.windows(2) {
            assert_eq!(pair[0].end(), u32::from(pair[1].address));
        }
    }
    assert_eq!(BLOCKS.map(|b| b.last().unwrap().end()), [0x8015, 0x8105, 0x821A]);
}

#[test]
fn the_hold_is_mapped_where_authority_is_on() {
    use drivegate_core::permit::{HoldState, HoldView};
    let now = Instant::now();
    let image = running(now);
    let reading = image.reading(now, STALE_AFTER);
    let view = |hold| DriveView::new(&reading, BusState::Up).with_hold(hold);
    assert_eq!(view(None).registers(0x8013, 2), Ok(vec![0xFFFF, 0xFFFF]));
    assert_eq!(view(None).registers(0x8104, 1), Err(Exception::ADDRESS));
    let seen = |state, left_s| HoldView {
        state,
        holder: None,
        rank: None,
        left_s,
    };
    for (state, left, own, expected) in [
        (HoldState::Free, Some(0), false, [0, 0, 0]),
        (HoldState::Held, Some(24), true, [1, 24, 1]),
        (HoldState::Held, Some(24), false, [2, 24, 0]),
        (HoldState::Local, None, false, [3, 0xFFFF, 0]),
        (HoldState::Reserved, Some(99_999), false, [4, 65_534, 0]),
    ] {
        let view = view(Some((seen(state, left), own)));
        assert_eq!(view.registers(0x8013, 2).unwrap(), expected[..2], "{state:?}");
        assert_eq!(view.registers(0x8103, 2).unwrap(), [0, expected[2]], "{state:?}");
    }
}
