//! The parameters of a drive: none, stored ones, a reading in progress, one that failed, a damaged file.

use std::fs;
use std::time::Duration;

use drivegate_core::parameters::{Entry, Id, ParameterFile, Store};
use drivegate_model::drive::parameters::RawValue;
use serde_json::{Value, json};

use super::client::get;
use super::plant::{self, Server};

const PLACE: &str = "/api/v1/drives/pump-1/params";

fn reading() -> ParameterFile {
    let good = Entry {
        value: Ok(RawValue::Word(5000)),
        note: "50.00 Hz, Maximum frequency".to_string(),
    };
    let bad = Entry {
        value: Err("exception 04".to_string()),
        note: "Acceleration time 1".to_string(),
    };
    ParameterFile {
        drive: "pump-1".to_string(),
        family: "vacon-nx".to_string(),
        identification: "none".to_string(),
        time: "2026-03-02T07:40:12Z".to_string(),
        counters: "812 messages received, 3 damaged".to_string(),
        values: [(Id::new("102"), good), (Id::new("103"), bad)].into(),
    }
}

async fn json_of(server: &Server) -> Value {
    let reply = get(server.address, PLACE).await;
    assert_eq!(reply.status, 200, "{}", reply.body);
    reply.json()
}

#[tokio::test]
async fn the_last_reading_and_the_present_one_are_served() {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::new(folder.path().join("params"));
    let plant = plant::mixed();
    let machine = plant.drive("pump-1").unwrap().machine();
    let server = Server::of(plant).await;
    let vault = server.stats.parameters.clone();
    let nothing = json!({"drive": "pump-1", "last": null, "reading": null, "error": null});
    assert_eq!(json_of(&server).await, nothing, "nothing is kept anywhere");
    vault.configure(Some(store.clone()), Default::default());
    assert_eq!(json_of(&server).await, nothing, "nothing was read");

    let file = reading();
    store.keep(&file).unwrap();
    let last = json!({
        "family": "vacon-nx", "identification": "none", "application": file.application(),
        "time": "2026-03-02T07:40:12Z", "counters": "812 messages received, 3 damaged", "checksum": file.checksum(), "missing": 1,
        "parameters": [
            {"id": "102", "raw": 5000.0, "text": "50.00 Hz, Maximum frequency"},
            {"id": "103", "raw": null, "text": "Acceleration time 1", "why": "exception 04"},
        ],
    });
    assert_eq!(json_of(&server).await["last"], last, "from the disk");

    vault.begin(&machine).unwrap();
    vault.update(&machine, |job| {
        (job.progress, job.remaining) = ((30, 90), Some(Duration::from_secs(2)));
        job.waits = Some("the drive is offline".to_string());
    });
    let goes_on = json_of(&server).await;
    let present = json!({"done": 30, "total": 90, "remaining_s": 2.0, "waits": "the drive is offline"});
    assert_eq!((&goes_on["reading"], &goes_on["last"]), (&present, &last));

    vault.end(&machine, Err("the bus is gone".to_string()));
    let failed = json_of(&server).await;
    assert_eq!(failed["error"], "the bus is gone");
    assert_eq!((&failed["reading"], &failed["last"]), (&Value::Null, &last));

    let mut newer = file.clone();
    newer.time = "2026-03-02T08:00:00Z".to_string();
    vault.end(&machine, Ok(newer));
    let done = json_of(&server).await;
    assert_eq!(done["last"]["time"], "2026-03-02T08:00:00Z");
    assert_eq!(done["error"], Value::Null);
    // While the next reading is in progress the last one stays available, although the disk has an older one.
    vault.begin(&machine).unwrap();
    assert_eq!(json_of(&server).await["last"]["time"], "2026-03-02T08:00:00Z");
}

#[tokio::test]
async fn an_unknown_drive_and_a_damaged_file_are_told() {
    let folder = tempfile::tempdir().unwrap();
    let store = Store::new(folder.path().to_path_buf());
    let kept = store.keep(&reading()).unwrap();
    let text = fs::read_to_string(&kept).unwrap();
    fs::write(&kept, text.replace("102 = 5000", "102 = 5001")).unwrap();
    let server = Server::of(plant::mixed()).await;
    server.stats.parameters.configure(Some(store), Default::default());
    let unknown = get(server.address, "/api/v1/drives/pump-9/params").await;
    assert_eq!(unknown.status, 404);
    assert!(
        unknown.body.contains("`pump-9`") && unknown.body.contains("pump-1"),
        "{}",
        unknown.body
    );
    let damaged = get(server.address, PLACE).await;
    assert_eq!(damaged.status, 500);
    assert!(damaged.body.contains(kept.to_str().unwrap()), "{}", damaged.body);
}
