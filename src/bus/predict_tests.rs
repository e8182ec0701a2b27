use std::sync::Arc;

use super::*;
use crate::cache::{Access, OnShutdown};
use crate::codec::Protocol;
use crate::drive::Profile;

/// A family whose drives are read by one fast request of 11 registers, and by slow ones of 10 each.
fn profile(bauds: &str, slow: usize) -> Arc<Profile> {
    let mut text = format!(
        "name = \"p\"\nprotocols = [\"modbus-rtu\"]\nbauds = {bauds}\nturnaround = \"0.5ms\"\n\
         [[range]]\ntable = \"holding\"\nfirst = 2100\nlast = 2110\nread = 11\nholes = true\n"
    );
    for k in 0..slow {
        let first = 100 * k;
        text += &format!(
            "[[range]]\ntable = \"holding\"\nfirst = {first}\nlast = {}\nread = 10\nholes = true\n",
            first + 9
        );
        for address in [first, first + 9] {
            text += &format!("[[point]]\nname = \"s{address}\"\nat = \"holding {address}\"\nclass = \"slow\"\n");
        }
    }
    for address in [2100, 2110] {
        text += &format!("[[point]]\nname = \"f{address}\"\nat = \"holding {address}\"\nclass = \"fast\"\n");
    }
    Arc::new(Profile::parse("p.toml", &text, false).unwrap())
}

fn drives(profile: &Arc<Profile>, count: u8) -> Vec<DriveSpec> {
    let drive = |address| DriveSpec {
        name: format!("d{address}"),
        bus: "b".into(),
        address,
        unit: address,
        profile: profile.clone(),
        access: Access::Monitor,
        limits: Default::default(),
        supervision: None,
        on_shutdown: OnShutdown::Hold,
        turnaround: profile.turnaround,
        frequency_range: None,
    };
    (1..=count).map(drive).collect()
}

fn spec(baud: u32, cycle_ms: u64, slow_ms: u64) -> BusSpec {
    BusSpec {
        name: "b".into(),
        port: "/dev/null".into(),
        protocol: Protocol::ModbusRtu,
        format: LineFormat::new(baud, "8N1").unwrap(),
        cycle: Duration::from_millis(cycle_ms),
        slow_cycle: Duration::from_millis(slow_ms),
    }
}

fn ms(time: Option<Duration>) -> f64 {
    time.map_or(f64::NAN, |t| t.as_secs_f64() * 1e3)
}

#[track_caller]
fn near(found: f64, wanted: f64) {
    assert!(
        (found - wanted).abs() < 0.001 * wanted.max(1.0),
        "{found} is not {wanted}"
    );
}

#[test]
fn wire_time_is_request_turnaround_reply_silence() {
    // 38400 8N1, 10 bits a character: request 8 characters 2.0833 ms, turnaround 0.5 ms, reply of 11
    // registers 27 characters 7.03125 ms, silence 0.9115 ms or 1.75 ms.
    let drives = drives(&profile("[]", 0), 1);
    for (silence, wanted) in [
        (Silence::Chars, 10.526),
        (Silence::Spec, 11.3646),
        (Silence::Fixed(Duration::from_millis(5)), 14.6146),
    ] {
        let p = predict(&spec(38_400, 20, 1000), silence, &drives);
        near(ms(Some(p.requests[0].wire)), wanted);
        near(ms(p.fast_cycle), 20.0);
        near(p.load(), wanted / 20.0);
        assert_eq!((p.slow_cycle, p.shortage), (None, None));
    }
}

#[test]
fn a_saturated_line_gives_slow_polls_five_percent() {
    // Fast round 10 x 10.526 ms; slow round 10 x 2 requests of 10 registers: 8 + 25 characters, 10.005 ms.
    let drives = drives(&profile("[9600, 38400]", 2), 10);
    let p = predict(&spec(38_400, 10, 1000), Silence::Chars, &drives);
    near(ms(p.fast_cycle), 105.26 / 0.95);
    near(ms(p.slow_cycle), 200.1 / 0.05);
    assert_eq!(p.load(), 1.0);
    near(p.demand, 10.526 + 0.2001);
    let shortage = p.shortage.unwrap();
    assert_eq!(shortage.fast.unwrap().requests, 10);
    assert_eq!(shortage.slow.unwrap().requests, 20);
    // 131.6 ms is what the fast class can have beside the full slow one: 105.26 / (1 - 0.2001). One drive
    // alone asks too much: no split helps.
    let cycle = Duration::from_millis(132);
    assert_eq!(shortage.remedies, [Remedy::Cycle { cycle, baud: None }]);
    assert_eq!(
        shortage.message(),
        "the line cannot carry cycle = \"10ms\" and slow_cycle = \"1s\": fast rounds of 10 requests take 105.3 ms \
         and come every 110.8 ms, slow rounds of 20 requests take 200.1 ms and come every 4002.1 ms; set cycle = \"132ms\""
    );
    let carried = predict(&spec(38_400, 132, 1000), Silence::Chars, &drives);
    assert_eq!(carried.shortage, None);
}

#[test]
fn the_highest_baud_is_told_even_when_it_does_not_carry_all() {
    // At 9600 a drive takes 40.6 ms, at 38400 10.526 ms.
    let drives = drives(&profile("[9600, 19200, 38400]", 0), 1);
    let p = predict(&spec(9600, 10, 1000), Silence::Chars, &drives);
    let cycle = |ms, baud| Remedy::Cycle {
        cycle: Duration::from_millis(ms),
        baud,
    };
    assert_eq!(p.shortage.unwrap().remedies, [cycle(11, Some(38_400)), cycle(41, None)]);
}

#[test]
fn slow_polls_take_what_is_left() {
    // 5 fast requests of 10.526 ms in 75 ms leave 29.8 %; slow round 100.05 ms in 200 ms asks for 50 %.
    let drives = drives(&profile("[38400]", 2), 5);
    let p = predict(&spec(38_400, 75, 200), Silence::Chars, &drives);
    near(ms(p.fast_cycle), 75.0);
    near(ms(p.slow_cycle), 100.05 / (1.0 - 52.63 / 75.0));
    let shortage = p.shortage.unwrap();
    assert_eq!((shortage.fast, shortage.slow.map(|s| s.requests)), (None, Some(10)));
    let longer = Remedy::SlowCycle(Duration::from_millis(336));
    assert!(shortage.remedies.contains(&longer), "{shortage:?}");
    assert_eq!(predict(&spec(38_400, 75, 336), Silence::Chars, &drives).shortage, None);
}

#[test]
fn the_least_baud_of_the_profile_that_would_do() {
    let drives = drives(&profile("[9600, 19200, 38400, 115200]", 0), 3);
    let p = predict(&spec(9600, 40, 1000), Silence::Chars, &drives);
    assert_eq!(p.shortage.as_ref().unwrap().remedies[0], Remedy::Baud(38_400));
    let message = p.shortage.unwrap().message();
    assert!(
        message.contains("cannot carry cycle = \"40ms\"") && message.contains("set baud = 38400"),
        "{message}"
    );
    let at = predict(&spec(38_400, 40, 1000), Silence::Chars, &drives);
    assert_eq!(at.shortage, None);
}

#[test]
fn a_family_without_bauds_gets_the_usual_ones() {
    let drives = drives(&profile("[]", 0), 3);
    let p = predict(&spec(38_400, 15, 1000), Silence::Chars, &drives);
    assert_eq!(p.shortage.as_ref().unwrap().remedies[0], Remedy::Baud(115_200));
}

#[test]
fn else_the_bus_is_split() {
    // At 38400 a drive takes 10.526 ms of 25 ms: two on a bus, seven drives on four buses.
    let drives = drives(&profile("[19200, 38400]", 0), 7);
    let p = predict(&spec(38_400, 25, 1000), Silence::Chars, &drives);
    assert_eq!(
        p.shortage.as_ref().unwrap().remedies[0],
        Remedy::Split { buses: 4, baud: None }
    );
    assert!(p.shortage.unwrap().message().contains("split the bus in 4 buses"));
    // At 19200 one drive takes 20.6 ms: seven buses there, four at 38400.
    let p = predict(&spec(19_200, 25, 1000), Silence::Chars, &drives);
    let split = Remedy::Split {
        buses: 4,
        baud: Some(38_400),
    };
    assert_eq!(p.shortage.as_ref().unwrap().remedies[0], split);
}

#[test]
fn nothing_to_read_is_no_load() {
    let p = predict(&spec(9600, 10, 1000), Silence::Spec, &[]);
    assert_eq!((p.fast_cycle, p.slow_cycle, p.load()), (None, None, 0.0));
    assert!(p.requests.is_empty() && p.shortage.is_none());
}

#[test]
fn the_built_in_family_reads_as_planned() {
    let profiles = crate::drive::profile::Profiles::built_in();
    let drives = drives(profiles.get("vacon-nx").unwrap(), 2);
    let p = predict(&spec(9600, 100, 1000), Silence::Spec, &drives);
    let of_first: Vec<_> = p
        .requests
        .iter()
        .filter(|r| r.drive == 0)
        .map(|r| (r.read.class, r.read.start, r.read.count))
        .collect();
    let (fast, slow, once) = (PollClass::Fast, PollClass::Slow, PollClass::Once);
    assert_eq!(
        of_first,
        [
            (fast, 2100, 11),
            (slow, 7, 2),
            (slow, 2000, 3),
            (once, 100, 4),
            (once, 732, 2)
        ]
    );
    // 9600 8N1: (8 + 27) characters of 1.0417 ms, turnaround 2 ms, silence 3.6458 ms.
    near(ms(Some(p.requests[0].wire)), 42.104);
}
