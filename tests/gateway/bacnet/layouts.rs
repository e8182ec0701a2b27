//! All objects in one device, and clients of other networks.

use serde_json::json;

use super::{PV, pumps};
use crate::support::process::{api, until};

#[test]
fn one_device_has_the_objects_of_all_drives() {
    let mut plant = pumps("layout = \"flat\"");
    let here = |object: &str, property: &str| json!(["read", 0, object, property]);
    let write = |object: &str, value: serde_json::Value| json!(["write", 0, object, PV, value, 8]);
    until("no other device", || {
        let seen = plant.bacpypes(20, &[json!(["who_is", null, null, "global"])]);
        (seen == [json!([100])]).then_some(())
    });
    let answers = plant.bacpypes(
        20,
        &[
            here("device,100", "object-list"),
            here("analog-input,1001", "object-name"),
            here("analog-input,2001", "object-name"),
            write("analog-value,1001", json!(50.0)),
            write("binary-value,1001", json!(true)),
            here("binary-value,1001", "current-command-priority"),
            write("analog-value,2001", json!(50.0)),
            json!(["read", 1, "analog-input,1", PV]),
        ],
    );
    let list = answers[0].as_array().unwrap();
    for object in [
        "analog-input,1001",
        "analog-input,2001",
        "binary-value,1001",
        "multi-state-input,2001",
    ] {
        assert!(list.contains(&json!(object)), "{object}: {list:?}");
    }
    assert_eq!(
        answers[1..3],
        [json!("pump-1.actual_speed"), json!("pump-2.actual_speed")]
    );
    assert_eq!(answers[3..6], [json!("done"), json!("done"), json!(8)]);
    assert!(answers[6]["error"].is_array(), "pump-2 takes no orders: {}", answers[6]);
    assert!(
        answers[7].get("failed").is_some() || answers[7].get("abort").is_some(),
        "{}",
        answers[7]
    );
    plant.site.until_state("pump-1", "running");
    assert_ne!(api(plant.site.http, "pump-2")["state"], "running");
    plant.bacpypes(20, &[write("binary-value,1001", json!(false))]);
    plant.site.until_state("pump-1", "ready");
    // A drive that is offline is shown as a fault of its objects; the device continues to answer.
    plant.drives.signal("TERM");
    plant.drives.ended();
    until("the fault", || {
        let seen = plant.bacpypes(
            20,
            &[
                json!(["who_is", null, null, "global"]),
                here("analog-input,1001", "reliability"),
            ],
        );
        (seen == [json!([100]), json!(12)]).then_some(())
    });
}

#[test]
fn foreign_devices_find_all_by_broadcast() {
    let everywhere = [json!(["who_is", null, null, "everywhere"])];
    let plant = pumps("foreign_devices = 2");
    until("all devices", || {
        let heard = plant.bacpypes_as(20, &["foreign"], &everywhere);
        (heard == [json!([100, 101, 102])]).then_some(())
    });
    let refusing = pumps("");
    let heard = refusing.bacpypes_as(20, &["foreign"], &everywhere);
    assert_eq!(heard, [json!([])], "it serves no foreign devices");
}
