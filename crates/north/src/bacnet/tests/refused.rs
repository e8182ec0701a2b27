//! A reload that is refused after the server has prepared its part: nothing of it takes effect.

use std::path::Path;

use arc_swap::ArcSwap;

use drivegate_core::files::State as _;
use drivegate_core::files::names::BACNET_PRIORITIES;

use super::super::kept::KeptSlots;
use super::*;
use drivegate_core::order::Entry;

fn keeping(dir: &Path) -> Options {
    Options {
        keep_priorities: true,
        state_dir: dir.into(),
        ..options()
    }
}

#[tokio::test]
async fn a_refused_reload_leaves_slots_and_rights_and_where_slots_are_kept() {
    let (here, elsewhere) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let (file, other) = (
        here.path().join(BACNET_PRIORITIES),
        elsewhere.path().join(BACNET_PRIORITIES),
    );
    let rig = ControlledDrive::new();
    let (drive, plant) = (rig.drive(), Arc::new(ArcSwap::from(rig.view.plant.clone())));
    let cancel = CancellationToken::new();
    let started = <Server as server::Server>::start(keeping(here.path()), plant, Arc::default(), cancel.clone());
    let mut server = started.await.unwrap();
    let right = server.rights.of(&"127.0.0.5:47808".parse().unwrap());
    let protects_at = |priority| {
        let origin = Origin::new(SourceKind::Bacnet, "127.0.0.5:47808").with_right(right.clone());
        let entry = Entry::new(Value::Bool(false), origin, Instant::now());
        drive.priorities(|all| all.restore(Commanded::Run, priority, entry));
    };
    let kept = || {
        KeptSlots::load(&file)
            .ok()
            .flatten()
            .map(|KeptSlots(slots)| slots.len())
    };
    let until_kept = async |slots: usize| {
        while kept() != Some(slots) {
            assert!(!other.exists(), "slots are kept where the refused reload said");
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    protects_at(2);
    until_kept(1).await;
    let without_rights = Options {
        commands: false,
        write: Vec::new(),
        ..keeping(elsewhere.path())
    };
    let change = server.prepare(without_rights).await.unwrap();
    server.abort(change);
    assert!(right.allows("line1"), "a right has gone");
    protects_at(3);
    until_kept(2).await;
    cancel.cancel();
    server::Server::stopped(server).await;
    assert_eq!((kept(), other.exists()), (Some(2), false));
}
