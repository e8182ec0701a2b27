//! Drives that do not report whether they run, and what their registers show of a response of their own.

use super::*;
use drivegate_model::drive::DriveIndex;

fn cx() -> SupervisedDrive {
    let rig = SupervisedDrive::of(&drivegate_testkit::profile("vacon-cx"), LeaseAction::Stop);
    rig.heartbeat();
    rig
}

impl SupervisedDrive {
    fn refuses_running(&self) {
        let image = self.image();
        let raw = image
            .spec
            .profile
            .model_point(ModelPoint::Running)
            .and_then(|p| p.raw());
        let raw = raw.unwrap();
        image.update(|s| s.refuse(raw.table, raw.address, 1, Exception::ADDRESS));
    }

    /// Evaluates the lease `ms` later; returns the action.
    fn later(&mut self, ms: u64) -> Option<Command> {
        self.now += Duration::from_millis(ms);
        self.supervise();
        self.take()
    }
}

#[test]
fn where_the_drive_refuses_to_tell_its_run_command_stands_for_it() {
    for (run, acts) in [(Some(true), true), (Some(false), false), (None, true)] {
        let mut rig = cx();
        rig.refuses_running();
        assert!(rig.later(4_900).is_none());
        if let Some(run) = run {
            rig.shows(ModelPoint::Run, Value::Bool(run));
        }
        let action = rig.later(100);
        assert_eq!(action.map(|a| a.urgency()), acts.then_some(Urgency::Stop), "{run:?}");
        let unknown = rig
            .news
            .iter()
            .filter(|n| **n == News::RunningUnknown(DriveIndex::new(0)));
        assert_eq!((unknown.count(), rig.reported()), (1, usize::from(acts)), "{run:?}");
    }
}

#[test]
fn a_run_command_that_is_known_only_from_a_write_counts() {
    for (word, acts) in [(0, false), (1, true)] {
        let mut rig = cx();
        rig.refuses_running();
        rig.drive.words.learn(Table::Coil, 0, word);
        assert_eq!(rig.later(5_000).is_some(), acts, "{word}");
    }
}

#[test]
fn a_drive_whose_word_is_only_old_keeps_its_lease_until_it_tells() {
    let mut rig = cx();
    for _ in 0..4 {
        assert!(rig.later(1_000).is_none());
    }
    let offline = |rig: &SupervisedDrive| rig.image().update(|s| s.link = Link::Offline(SystemTime::now()));
    let online = |rig: &SupervisedDrive| rig.image().update(|s| s.link = Link::Online(SystemTime::now()));
    offline(&rig);
    for _ in 0..10 {
        assert!(rig.later(1_000).is_none());
    }
    assert_eq!(rig.news, []);
    online(&rig);
    assert!(rig.after(10, true).is_some());
    // The wait is limited: if the drive answers but its running state is not read again, the action follows when
    // the lease expires.
    let mut rig = cx();
    rig.look(0, true);
    rig.heartbeat();
    let heard = rig.now;
    let action = (0..100).find_map(|_| rig.later(100));
    assert!(action.is_some(), "the stop");
    assert!(rig.now - heard <= Duration::from_millis(5_100));
    assert_eq!(
        rig.news,
        [
            News::RunningUnknown(DriveIndex::new(0)),
            News::LeaseRanOut(DriveIndex::new(0))
        ]
    );
    // Only time in which the drive answers counts; the drive may go offline and return.
    let mut rig = cx();
    rig.look(0, true);
    rig.heartbeat();
    offline(&rig);
    assert!(rig.later(5_000).is_none());
    let (heard, mut answered) = (rig.now, Duration::ZERO);
    while rig.later(100).is_none() {
        assert!(rig.now - heard < Duration::from_secs(20));
        if rig.image().snapshot().link.is_online() {
            answered += Duration::from_millis(100);
            offline(&rig);
        } else {
            online(&rig);
        }
    }
    assert!(answered >= Duration::from_millis(1_800), "{answered:?}");
    // A drive that does not answer at all keeps its lease too, although it refused the point before.
    let mut rig = cx();
    rig.refuses_running();
    rig.image().update(|s| s.link = Link::Offline(SystemTime::now()));
    assert!(rig.later(10_000).is_none());
    assert_eq!(rig.news, []);
    rig.image().update(|s| s.link = Link::Online(SystemTime::now()));
    assert!(rig.later(10).is_some());
}

const START: &str = "name = \"p\"\nprotocols = [\"modbus-rtu\"]\n\
    [[range]]\ntable = \"holding\"\nfirst = 0\nlast = 999\nread = 30\n";

fn drive(points: &str) -> DriveImage {
    let profile = Profile::parse("p.toml", &format!("{START}{points}"), false).unwrap();
    let spec = DriveSpec {
        access: Access::Control,
        turnaround: Duration::ZERO,
        ..DriveSpec::new("d", "b", 1, Arc::new(profile))
    };
    image(spec)
}

fn reported(drive: &DriveImage, words: &[(u16, u16)]) -> OwnResponse {
    let now = Instant::now();
    for (address, word) in words {
        drive.update(|s| s.store(Table::Holding, *address, &[*word], now));
    }
    own_response(&drive.reading(now, Duration::from_secs(1)))
}

#[test]
fn what_the_points_tell_together() {
    let response = "[[point]]\nname = \"fieldbus_fault_response\"\nat = \"holding 732\"\nclass = \"once\"\n";
    let timeout = "[[point]]\nname = \"communication_timeout\"\nat = \"holding 542\"\nscale = 0.1\nunit = \"s\"\nclass = \"once\"\n";
    let other = "[[point]]\nname = \"other\"\nat = \"holding 7\"\nclass = \"once\"\n";
    assert_eq!(reported(&drive(other), &[(7, 0)]), OwnResponse::Unknown);
    let one = drive(response);
    assert_eq!(reported(&one, &[]), OwnResponse::Unknown, "not read yet");
    assert_eq!(reported(&one, &[(732, 0)]), OwnResponse::Off(FIELDBUS_FAULT_RESPONSE));
    assert_eq!(reported(&one, &[(732, 2)]), OwnResponse::On);
    let both = drive(&format!("{response}{timeout}"));
    assert_eq!(reported(&both, &[(732, 2)]), OwnResponse::Unknown);
    assert_eq!(reported(&both, &[(542, 0)]), OwnResponse::Off(COMMUNICATION_TIMEOUT));
    assert_eq!(reported(&both, &[(542, 50)]), OwnResponse::On);
}

/// Register 8 of Mitsubishi takes the control word and reads as the status: a motor that stands shows no run bit there, while
/// the run command written last is still in force.
#[test]
fn the_status_behind_an_unreadable_control_word_shows_no_run_command() {
    for (word, acts) in [(0x0002, true), (0x0000, false)] {
        let mut rig = SupervisedDrive::of(&drivegate_testkit::profile("mitsubishi-d700"), LeaseAction::Stop);
        rig.heartbeat();
        rig.drive.words.learn(Table::Holding, 8, word);
        rig.now += Duration::from_millis(4_900);
        let now = rig.now;
        rig.image().update(|s| s.store(Table::Holding, 8, &[0x0080], now));
        assert_eq!(rig.later(100).is_some(), acts, "{word:#06x}");
    }
}
