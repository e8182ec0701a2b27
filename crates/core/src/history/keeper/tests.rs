use std::io::ErrorKind;

use super::*;
use crate::event::{EventKind, Search};

fn event(n: u64) -> Event {
    let time = SystemTime::UNIX_EPOCH + Duration::from_millis(n);
    Event {
        bus: "line1".to_string(),
        drive: Some("pump-1".to_string()),
        ..Event::new(EventKind::Started, time, format!("event {n}"))
    }
}

/// A run of the gateway, without the thread.
struct Run {
    events: Events,
    history: Arc<History>,
    writer: Writer,
}

impl Run {
    fn new(dir: &Path) -> Run {
        let (events, history) = (Events::default(), Arc::<History>::default());
        let mut writer = Writer::new(dir, true, history.clone(), events.subscribe());
        events.remember(writer.remember());
        Run {
            events,
            history,
            writer,
        }
    }

    fn publish(&self, numbers: std::ops::Range<u64>) {
        numbers.for_each(|n| self.events.publish(event(n)));
    }

    fn work(&mut self) -> io::Result<()> {
        let done = self.writer.work(true);
        let told = done
            .as_ref()
            .copied()
            .map_err(|error| io::Error::new(error.kind(), error.to_string()));
        self.writer.report(done, false);
        told
    }

    /// Texts of the events, newest first.
    fn texts(&self) -> Vec<String> {
        let search = Search {
            kinds: Vec::new(),
            drive: None,
            bus: None,
            text: None,
            before: None,
            limit: usize::MAX,
        };
        self.events
            .search(&search)
            .iter()
            .map(|event| event.text.clone())
            .collect()
    }
}

fn totals(starts: u64, running_seconds: f64) -> BTreeMap<String, Totals> {
    let totals = Totals {
        starts,
        running_seconds,
        energy_kwh: Some(7.5),
    };
    [("pump-1".to_string(), totals)].into()
}

/// An event of another run has another name of the run.
fn another_run(dir: &Path) {
    let path = dir.join(EVENTS);
    let text = fs::read_to_string(&path).unwrap();
    fs::write(&path, text.replace(event::boot(), "0123456789abcdef")).unwrap();
}

#[test]
fn events_and_counters_survive_a_restart() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path().join("state");
    let mut run = Run::new(&dir);
    run.publish(0..3);
    run.history.count_on(totals(3, 12.5));
    run.work().unwrap();
    drop(run);
    another_run(&dir);
    let mut run = Run::new(&dir);
    assert_eq!(run.texts(), ["event 2", "event 1", "event 0"]);
    assert!(run.events.recent().is_empty(), "they are not of this run");
    assert_eq!(run.history.all_totals(), totals(3, 12.5));
    run.publish(3..5);
    assert_eq!(run.texts()[..3], ["event 4", "event 3", "event 2"]);
    assert_eq!(run.events.recent().len(), 2);
    run.work().unwrap();
    assert_eq!(
        fs::read_to_string(dir.join(EVENTS)).unwrap().lines().count(),
        5,
        "none twice"
    );
}

#[test]
fn files_are_bounded_and_the_oldest_events_go() {
    let dir = tempfile::tempdir().unwrap();
    let mut run = Run::new(dir.path());
    for hundred in 0..400 {
        run.publish(hundred * 100..(hundred + 1) * 100);
        run.work().unwrap();
    }
    let sizes: Vec<u64> = fs::read_dir(dir.path())
        .unwrap()
        .map(|file| file.unwrap().metadata().unwrap().len())
        .collect();
    assert!(sizes.iter().sum::<u64>() <= EVENT_FILES.0 + 4096, "{sizes:?}");
    assert!(sizes.len() as u64 <= EVENT_FILES.1 + 1);
    let last = run.writer.earlier().pop().unwrap();
    assert_eq!(last.text, "event 39999");
}

#[test]
fn a_line_that_was_cut_costs_itself_only() {
    let dir = tempfile::tempdir().unwrap();
    let mut run = Run::new(dir.path());
    run.publish(0..2);
    run.work().unwrap();
    drop(run);
    let path = dir.path().join(EVENTS);
    let whole = fs::read(&path).unwrap();
    let torn = (0..whole.len()).step_by(29).map(|length| whole[..length].to_vec());
    for bytes in torn.chain([[&whole[..], &[0; 700]].concat(), b"\xff\xfe\n[]\n{}".to_vec()]) {
        fs::write(&path, &bytes).unwrap();
        let before = Run::new(dir.path()).texts().len();
        let mut run = Run::new(dir.path());
        assert_eq!(run.texts().len(), before);
        run.publish(7..8);
        run.work().unwrap();
        drop(run);
        let text = fs::read(&path).unwrap();
        assert!(text.starts_with(&bytes), "nothing is removed");
        assert_eq!(Run::new(dir.path()).texts().len(), before + 1);
    }
}

#[test]
fn a_disk_that_is_full_costs_the_history_only() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join(EVENTS);
    let mut run = Run::new(dir.path());
    run.work().unwrap();
    fs::remove_file(&path).unwrap();
    std::os::unix::fs::symlink("/dev/full", &path).unwrap();
    run.publish(0..WAITING as u64 + 5);
    assert_eq!(run.work().unwrap_err().kind(), ErrorKind::StorageFull);
    assert!(run.writer.failing);
    assert_eq!((run.writer.waiting.len(), run.writer.lost), (WAITING, 5));
    assert_eq!(run.texts().len(), 4096, "they are in memory");
    fs::remove_file(&path).unwrap();
    run.work().unwrap();
    assert!(!run.writer.failing);
    assert_eq!(fs::read_to_string(&path).unwrap().lines().count(), WAITING);
    // The disk takes events, and no counters.
    let aside = dir.path().join("counters.partial");
    std::os::unix::fs::symlink("/dev/full", &aside).unwrap();
    run.history.count_on(totals(1, 1.0));
    run.publish(0..1);
    assert!(run.work().is_err());
    run.work().unwrap();
    assert_eq!(
        Run::new(&dir.path().join("elsewhere")).history.all_totals(),
        BTreeMap::new()
    );
}

#[test]
fn a_directory_that_comes_later_gets_what_was_counted_meanwhile() {
    let dir = tempfile::tempdir().unwrap();
    let mut before = Run::new(&dir.path().join("state"));
    before.history.count_on(totals(3, 10.0));
    before.work().unwrap();
    // The other process still has the directory locked.
    let mut run = Run::new(&dir.path().join("state"));
    assert!(run.writer.failing);
    assert_eq!(run.history.all_totals(), BTreeMap::new());
    run.history.count_on(totals(1, 2.0));
    assert!(run.work().unwrap_err().to_string().contains("another process"));
    drop(before);
    run.work().unwrap();
    let all = run.history.all_totals();
    assert_eq!((all["pump-1"].starts, all["pump-1"].running_seconds), (4, 12.0));
}

#[test]
fn counters_that_cannot_be_read_are_kept_aside_and_never_cut() {
    let newer = r#"{"drivegate_counters": 2, "hours": {}}"#;
    let negative = r#"{"drivegate_counters": 1, "drives": {"a": {"starts": 1, "running_seconds": -4.0}}}"#;
    for (place, text) in ["", "{", "[]", newer, negative, "\u{0}\u{0}"].into_iter().enumerate() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join(COUNTERS);
        fs::write(&path, text).unwrap();
        fs::write(dir.path().join("counters.damaged-1"), "from before").unwrap();
        let mut run = Run::new(dir.path());
        assert_eq!(run.history.all_totals(), BTreeMap::new());
        run.history.count_on(totals(1, 1.0));
        run.work().unwrap();
        assert_eq!(
            fs::read_to_string(dir.path().join("counters.damaged-2")).unwrap(),
            text,
            "{place}"
        );
        assert_eq!(
            fs::read_to_string(dir.path().join("counters.damaged-1")).unwrap(),
            "from before"
        );
        drop(run);
        assert_eq!(Run::new(dir.path()).history.all_totals(), totals(1, 1.0));
    }
}

#[test]
fn counters_that_the_disk_does_not_return_stay_and_cost_no_event() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join(COUNTERS);
    // A folder of this name cannot be read as a file.
    fs::create_dir(&path).unwrap();
    let mut run = Run::new(dir.path());
    run.history.count_on(totals(1, 2.0));
    run.publish(0..3);
    let why = run.work().unwrap_err().to_string();
    assert!(why.contains("cannot read") && why.contains(COUNTERS), "{why}");
    assert_eq!(fs::read_to_string(dir.path().join(EVENTS)).unwrap().lines().count(), 3);
    assert!(path.is_dir(), "it is neither replaced nor renamed");
    fs::remove_dir(&path).unwrap();
    fs::write(
        &path,
        r#"{"drives": {"pump-1": {"starts": 3, "running_seconds": 10.0}}}"#,
    )
    .unwrap();
    run.work().unwrap();
    assert_eq!(run.history.all_totals()["pump-1"].starts, 4);
}

#[tokio::test]
async fn the_thread_writes_what_it_has_when_it_ends() {
    let dir = tempfile::tempdir().unwrap();
    let (events, history) = (Events::default(), Arc::<History>::default());
    let (keeper, _) = keep(dir.path(), true, history.clone(), &events).unwrap();
    history.count_on(totals(5, 50.0));
    (0..10).for_each(|n| events.publish(event(n)));
    keeper.stop().await;
    another_run(dir.path());
    let run = Run::new(dir.path());
    assert_eq!((run.texts().len(), run.history.all_totals()), (10, totals(5, 50.0)));
}
