use std::path::Path;
use std::time::Duration;

use arc_swap::ArcSwap;
use drivegate_core::order::{Origin, SourceKind};
use drivegate_core::parameters::{NO_IDENTIFICATION, Phase, Plan, Store};
use drivegate_core::plant::Plant;
use drivegate_core::process_image::DriveImage;
use drivegate_testkit::{STALE_AFTER, bus, bus_spec, controlled, nx};

use super::super::release;
use super::*;

/// The drives `pump-1` and `fan-2`, and a directory of readings.
struct Held {
    dir: tempfile::TempDir,
    vault: Arc<Vault>,
    plant: SharedPlant,
    events: Events,
}

impl Held {
    fn new() -> Held {
        let dir = tempfile::tempdir().unwrap();
        let vault = Arc::new(Vault::default());
        vault.configure(Some(Store::new(dir.path().to_path_buf())), Default::default());
        let bus_spec = bus_spec("line1");
        let drive = |name, address| {
            let spec = controlled(name, "line1", address, &nx());
            let lock = vault.restore_lock(&bus_spec.machine(&spec));
            Arc::new(DriveImage::new(spec, STALE_AFTER).with_restore_lock(lock))
        };
        let drives = vec![drive("pump-1", 1), drive("fan-2", 2)];
        let plant = Plant::new("hall", STALE_AFTER, vec![bus(bus_spec.clone(), drives)]);
        Held {
            dir,
            plant: Arc::new(ArcSwap::from_pointee(plant)),
            vault,
            events: Events::default(),
        }
    }

    fn drive(&self, name: &str) -> DriveHandle {
        self.plant.load().drive(name).unwrap()
    }

    /// Why the drive accepts only stops.
    fn held(&self, name: &str) -> Option<String> {
        let why = self.drive(name).image.restore_lock.reason();
        why.map(|why| why.to_string())
    }

    /// The search at a start or a reload; the first look at the disk is over when this returns.
    async fn search(&self) {
        let plant = self.plant.load();
        let drives = plant
            .buses
            .iter()
            .flat_map(|bus| bus.image.drives.iter().map(|drive| (&bus.image.spec, &drive.spec)));
        hold_unfinished(&self.vault, &self.events, &Patience::default(), drives).await;
    }

    /// Waits until these drives are held because this file cannot be read.
    async fn held_by(&self, path: &Path, drives: [&str; 2]) {
        let path = path.to_str().unwrap();
        let named = |why: String| {
            let parts = ["until its journal is read", path, "move it away"];
            parts.iter().all(|part| why.contains(part))
        };
        let all = async {
            while !drives.iter().all(|drive| self.held(drive).is_some_and(named)) {
                tokio::time::sleep(Duration::from_millis(1)).await;
            }
        };
        let held = tokio::time::timeout(Duration::from_secs(60), all).await;
        assert!(held.is_ok(), "{path}: {:?}", drives.map(|drive| self.held(drive)));
    }

    /// A journal below this name that cannot be read, not even by root: a link to itself.
    fn unreadable(&self, name: &str) -> PathBuf {
        let path = self.dir.path().join(name).join("restore.journal");
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::os::unix::fs::symlink(&path, &path).unwrap();
        path
    }

    /// The disk returns the journal, which belongs to this drive under an earlier name.
    fn returns(&self, path: &Path, drive: &str, earlier: &str) {
        let handle = self.drive(drive);
        let machine = handle.machine();
        let journal = Journal {
            of: Owner {
                drive: earlier.to_string(),
                bus: "line1".to_string(),
                family: machine.profile.clone(),
                machine: Some(machine),
                identification: NO_IDENTIFICATION.to_string(),
            },
            begun: "2026-03-02T07:40:12Z".to_string(),
            by: "local_socket uid 0".to_string(),
            phase: Phase::Writing,
            done: 0,
            saved: false,
            plan: Plan::default(),
        };
        std::fs::remove_file(path).unwrap();
        std::fs::write(path, journal.text(&nx())).unwrap();
    }
}

#[tokio::test]
async fn a_journal_that_is_not_read_may_belong_to_any_drive_without_one_of_its_own() {
    for earlier in ["old-name", "pump-1"] {
        let site = Held::new();
        let path = site.unreadable(earlier);
        for _ in ["a start", "a reload"] {
            site.search().await;
            site.held_by(&path, ["pump-1", "fan-2"]).await;
        }
        site.returns(&path, "fan-2", earlier);
        site.search().await;
        let why = site.held("fan-2").unwrap_or_default();
        assert!(why.contains("--resume fan-2"), "{earlier}: {why}");
        assert_eq!(site.held("pump-1"), None, "{earlier}");
    }
}

#[tokio::test]
async fn the_file_that_cannot_be_read_is_named_to_people_who_can_release_a_drive() {
    let site = Held::new();
    let path = site.unreadable("old-name");
    site.search().await;
    site.held_by(&path, ["pump-1", "fan-2"]).await;
    let origin = Origin::new(SourceKind::LocalSocket, "uid 0");
    release(&site.plant, &site.vault, &site.drive("pump-1"), &origin)
        .await
        .unwrap();
    assert_eq!(site.held("pump-1"), None);
    // A reload looks for the journals of new drives only.
    site.search().await;
    assert_eq!(site.held("pump-1"), None);
    site.held_by(&path, ["fan-2", "fan-2"]).await;
}
