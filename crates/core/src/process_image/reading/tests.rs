use std::sync::Arc;
use std::time::SystemTime;

use super::*;
use crate::process_image::{Cadence, Link};
use crate::testkit::{STALE_AFTER, image, monitored, nx, online, profile};
use drivegate_model::drive::Profile;
use drivegate_proto::Exception;

/// A value that depends on the drive's frequency range is not shown worse than the values of that range.
#[test]
fn a_value_within_a_band_is_as_good_as_the_band() {
    let profile = nx();
    let index = |name: &str| profile.point_index(name).unwrap();
    let reference = index("frequency_reference");
    let image = image(monitored("pump-1", "line1", 1, &profile));
    let now = Instant::now();
    let sample = || image.reading(now, STALE_AFTER).sample(reference);
    let store = |name: &str, value: f64| {
        let raw = profile.points.get(index(name)).unwrap().raw().unwrap().clone();
        let words = raw.encode(Value::Number(value), 0).unwrap();
        image.update(|s| s.store(raw.table, raw.address, &words, now));
    };
    online(&image);
    store("speed_reference", 50.0);
    assert_eq!(sample(), Sample::NONE, "no range is known");
    store("minimum_frequency", 10.0);
    store("maximum_frequency", 50.0);
    let expected = |quality| (Some(Value::Number(30.0)), quality);
    assert_eq!((sample().value, sample().quality), expected(Quality::Good));
    image.update(|s| s.link = Link::Offline(SystemTime::now()));
    assert_eq!((sample().value, sample().quality), expected(Quality::Stale));
    store("maximum_frequency", 10.0);
    assert_eq!(sample(), Sample::NONE, "an empty range");
}

/// The state depends on fault, running and ready in this order, and only on those that are needed.
#[test]
fn a_state_is_known_only_when_what_decides_it_is() {
    let cx = profile("vacon-cx");
    let image = image(monitored("fan-1", "line1", 1, &cx));
    let now = Instant::now();
    let seen = || {
        let reading = image.reading(now, STALE_AFTER);
        (reading.state(), reading.overall())
    };
    let bit = |address, word| image.update(|s| s.store(Table::DiscreteInput, address, &[word], now));
    let refuse = |address| image.update(|s| s.refuse(Table::DiscreteInput, address, 1, Exception::ADDRESS));
    let (ready, running, fault) = (1, 2, 4);
    assert_eq!(seen(), (Some(State::Offline), Quality::Bad));
    image.update(|s| (s.link, s.fast_at) = (Link::Online(SystemTime::now()), Some(now)));
    assert_eq!(seen(), (None, Quality::Bad), "nothing is read yet");
    bit(ready, 1);
    bit(fault, 0);
    assert_eq!(seen(), (None, Quality::Bad), "running is not");
    bit(running, 0);
    assert_eq!(seen(), (Some(State::Ready), Quality::Good));
    refuse(running);
    assert_eq!(seen(), (None, Quality::Bad), "it may run");
    bit(fault, 1);
    assert_eq!(seen(), (Some(State::Fault), Quality::Good), "whether it runs or not");
    refuse(fault);
    bit(running, 1);
    assert_eq!(seen(), (None, Quality::Bad), "it may have a fault");
    bit(fault, 0);
    refuse(ready);
    assert_eq!(seen(), (Some(State::Running), Quality::Good), "needs no word of ready");
    let late = now + Duration::from_millis(900);
    image.update(|s| {
        s.fast_at = Some(late);
        s.store(Table::DiscreteInput, fault, &[0], late);
    });
    let reading = image.reading(now + Duration::from_millis(1100), Duration::from_secs(1));
    assert_eq!(
        (reading.state(), reading.overall()),
        (None, Quality::Stale),
        "running is old"
    );
}

/// Parameters may have changed while the drive was offline.
#[test]
fn parameters_from_before_a_drive_went_away_are_not_believed() {
    let cx = profile("vacon-cx");
    let maximum = cx.point_index("maximum_frequency").unwrap();
    let program = cx.point_index("control_program").unwrap();
    let image = image(monitored("fan-1", "line1", 1, &cx));
    let now = Instant::now();
    let seen = || {
        let reading = image.reading(now, STALE_AFTER);
        let band = reading.band_for_commands(Bound::Fixed(0.0), Bound::Point(maximum));
        (reading.sample(maximum).quality, reading.sample(program).quality, band)
    };
    image.update(|s| {
        s.link = Link::Online(SystemTime::now());
        s.store(Table::Holding, 101, &[50], now);
        s.store(Table::Input, 17, &[1], now);
    });
    assert_eq!(seen(), (Quality::Good, Quality::Good, Some((0.0, 50.0))));
    image.update(Snapshot::expire_slow_values);
    assert_eq!(seen(), (Quality::Stale, Quality::Stale, None));
    image.update(|s| s.store(Table::Holding, 101, &[100], now));
    assert_eq!(seen(), (Quality::Good, Quality::Stale, Some((0.0, 100.0))));
}

/// A family without a bit decides without it.
#[test]
fn what_a_family_lacks_decides_nothing() {
    let source = "name = \"m\"\nprotocols = [\"modbus-rtu\"]\n[[range]]\ntable = \"holding\"\nfirst = 0\nlast = 9\n\
         [[point]]\nname = \"running\"\nat = \"holding 1.0\"\nclass = \"fast\"\n";
    let profile = drivegate_model::drive::Profile::parse("m.toml", source, false).unwrap();
    let image = image(monitored("m", "line1", 1, &Arc::new(profile)));
    let now = Instant::now();
    for (word, state) in [(1, State::Running), (0, State::NotReady)] {
        image.update(|s| {
            (s.link, s.fast_at) = (Link::Online(SystemTime::now()), Some(now));
            s.store(Table::Holding, 1, &[word], now);
        });
        let reading = image.reading(now, STALE_AFTER);
        assert_eq!((reading.state(), reading.overall()), (Some(state), Quality::Good));
    }
}

/// Another master polls one register after the other, then other drives for six seconds.
#[test]
fn what_counts_is_the_pause_between_reads_of_the_same_registers() {
    let nx = nx();
    let image = image(monitored("fan-1", "line1", 1, &nx));
    let read = image
        .plan
        .reads
        .iter()
        .find(|read| read.class == PollClass::Fast)
        .unwrap();
    let addresses: Vec<u16> = (read.start..).take(usize::from(read.count)).collect();
    assert!(addresses.len() > 3, "more than one");
    image.update(|s| (s.link, s.heard) = (Link::Online(SystemTime::now()), Some(Cadence::default())));
    let mut now = Instant::now();
    let is_stale = |now| image.reading(now, STALE_AFTER).is_stale();
    for _ in 0..4 {
        for address in &addresses {
            now += Duration::from_millis(50);
            image.update(|s| assert!(s.hear(read.table, *address, &[1], now)));
        }
        now += Duration::from_secs(6);
    }
    assert!(!is_stale(now), "three rounds are over");
    assert!(!is_stale(now + Duration::from_secs(10)) && is_stale(now + Duration::from_secs(16)));
}

/// A scale in another register: without it there is no value, an invalid power gives none, and the quality never
/// improves by it.
#[test]
fn a_scale_in_another_register() {
    let text = "name = \"p\"\nprotocols = [\"modbus-rtu\"]\n[[range]]\ntable = \"holding\"\nfirst = 0\nlast = 9\nread = 5\n\
        [[point]]\nname = \"power\"\nat = \"holding 0\"\ntype = \"i16\"\nscale_from = \"sf\"\nclass = \"fast\"\n\
        [[point]]\nname = \"sf\"\nat = \"holding 5\"\ntype = \"i16\"\ninvalid = [0x8000]\nclass = \"slow\"\nhidden = true\n\
        [[point]]\nname = \"count\"\nat = \"holding 1\"\ntype = \"u64\"\nclass = \"fast\"\n\
        [[point]]\nname = \"motor_current\"\nat = \"holding 6\"\ninvalid = [0x7FFF]\nclass = \"fast\"\n";
    let profile = Arc::new(drivegate_model::drive::Profile::parse("p.toml", text, false).unwrap());
    let names: Vec<_> = crate::process_image::public_points(&profile)
        .into_iter()
        .map(|(_, n)| n.to_string())
        .collect();
    assert_eq!(names, ["motor_current", "power", "count"], "hidden ones are not shown");
    let image = image(monitored("pump-1", "line1", 1, &profile));
    let (now, seconds) = (Instant::now(), Duration::from_secs);
    let seen = |name: &str, after| {
        let sample = image
            .reading(now + seconds(after), seconds(100))
            .sample(profile.point_index(name).unwrap());
        (sample.value, sample.quality)
    };
    let store =
        |start, words: &[u16], after| image.update(|s| s.store(Table::Holding, start, words, now + seconds(after)));
    online(&image);
    store(0, &[1234, 0x0020, 0, 0, 1], 0);
    assert_eq!(seen("power", 0), (None, Quality::Bad), "the scale was not read");
    assert_eq!(
        seen("count", 0),
        (Some(Value::Integer((1 << 53) + 1)), Quality::Good),
        "to the last digit"
    );
    store(5, &[0xFFFE], 0);
    assert_eq!(seen("power", 0), (Some(Value::Number(12.34)), Quality::Good));
    store(5, &[0x8000], 0);
    assert_eq!(seen("power", 0), (None, Quality::Bad));
    store(5, &[2], 0);
    assert_eq!(seen("power", 0), (Some(Value::Number(123_400.0)), Quality::Good));
    store(0, &[1234], 150);
    assert_eq!(
        seen("power", 150),
        (Some(Value::Number(123_400.0)), Quality::Stale),
        "as its scale"
    );
    store(6, &[0x7FFF], 0);
    assert_eq!(seen("motor_current", 0), (None, Quality::Bad), "not available");
    store(6, &[0x7FFE], 0);
    assert_eq!(seen("motor_current", 0).1, Quality::Good);
}

/// A meter behind transformers; its counter uses two registers.
#[test]
fn a_value_of_several_registers_is_as_good_as_all_of_them() {
    let text = "name = \"meter\"\nprotocols = [\"modbus-rtu\"]\n\
                [[range]]\ntable = \"holding\"\nfirst = 0\nlast = 9\nread = 10\n\
                [[point]]\nname = \"current\"\nat = \"holding 0\"\nscale = 0.001\nfactor_from = [\"ct\", \"turns\"]\n\
                [[point]]\nname = \"kwh\"\nat = \"holding 1\"\n[[point]]\nname = \"mwh\"\nat = \"holding 2\"\n\
                [[point]]\nname = \"total\"\nderive = \"sum\"\nof = [\"mwh\", \"kwh\"]\nweights = [1000, 1]\n\
                [[point]]\nname = \"ct\"\nat = \"holding 4\"\nclass = \"once\"\n\
                [[point]]\nname = \"turns\"\nat = \"holding 5\"\nclass = \"once\"\n";
    let meter = Arc::new(Profile::parse("meter.toml", text, false).unwrap());
    let image = image(monitored("meter", "line1", 1, &meter));
    online(&image);
    let now = Instant::now();
    let store = |address, words: &[u16], at| image.update(|s| s.store(Table::Holding, address, words, at));
    let seen = |name: &str| {
        let sample = image.reading(now, STALE_AFTER).sample(meter.point_index(name).unwrap());
        (sample.value, sample.quality)
    };
    store(0, &[1500, 999, 7], now);
    assert_eq!(seen("current"), (None, Quality::Bad), "no ratio is known");
    store(4, &[40], now);
    assert_eq!(seen("current"), (None, Quality::Bad), "nor both");
    store(5, &[2], now);
    assert_eq!(seen("current"), (Some(Value::Number(120.0)), Quality::Good));
    image.update(|s| s.refuse(Table::Holding, 4, 1, Exception::ADDRESS));
    assert_eq!(seen("current").1, Quality::Bad);
    assert_eq!(seen("total"), (Some(Value::Number(7999.0)), Quality::Good));
    // The counter rolls over between the reads of its two parts.
    store(1, &[0], now + Duration::from_millis(10));
    assert_eq!(seen("total"), (None, Quality::Bad), "it would go back by 999");
    store(1, &[0, 8], now + Duration::from_millis(20));
    assert_eq!(seen("total"), (Some(Value::Number(8000.0)), Quality::Good));
}
