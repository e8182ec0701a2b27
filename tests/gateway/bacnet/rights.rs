//! Slots of clients that a reload, or the next start, gives no right any more.

use super::*;

/// The configuration of the first plant of [`pumps`], changed so that each right in it is removed.
fn without_right(config: &str) -> Vec<(&'static str, String)> {
    let section = &config[config.find("[bacnet]").unwrap()..];
    let of = |from: &str, to: &str| {
        assert!(config.contains(from), "{from}");
        config.replace(from, to)
    };
    let write = "write = [\"127.0.0.16/28\"]";
    vec![
        ("[bacnet]", of(section, "")),
        ("commands", of("commands = true", "commands = false")),
        ("write", of(write, "write = [\"127.0.0.40/32\"]")),
        ("allow", of(write, &format!("{write}\nallow = [\"127.0.0.40/32\"]"))),
        ("access", of("access = \"control\"", "access = \"monitor\"")),
    ]
}

impl Plant {
    fn reload(&self, config: &str) {
        let count = || self.gateway.output().matches("configuration reloaded").count();
        let before = count();
        self.site.write("drivegate.conf", config);
        self.gateway.signal("HUP");
        until("the reload", || (count() > before).then_some(()));
    }

    /// Whether a slot blocks a start over Modbus TCP. The motor is at standstill afterwards.
    fn is_locked(&self) -> bool {
        let locked = until("an answer", || match mbpoll_write(self.site.modbus, 1, 33_024, &[1]) {
            Ok(()) => Some(false),
            Err(why) if why.contains("busy") => Some(true),
            Err(_) => None,
        });
        if !locked {
            until("a stop", || mbpoll_write(self.site.modbus, 1, 33_024, &[0]).ok());
            self.site.until_state("pump-1", "ready");
        }
        locked
    }

    fn void_events(&self) -> Vec<String> {
        let (status, body) = get(self.site.http, "/api/v1/events/log?kind=slot_void&limit=1000").unwrap();
        assert_eq!(status, 200, "{body}");
        let log: Json = serde_json::from_str(&body).unwrap();
        let texts = log.as_array().unwrap().iter().map(|event| event["text"].to_string());
        texts.collect()
    }
}

#[test]
fn a_slot_is_void_with_the_right_of_its_client_and_does_not_come_back_with_it() {
    let plant = pumps("keep_priorities = true");
    let config = std::fs::read_to_string(plant.site.config()).unwrap();
    // Reloads that leave the right, and one that is refused.
    assert_eq!(plant.bacpypes(20, &[run_at(3, false)]), [json!("done")]);
    plant.reload(&config.replace(
        "write = [\"127.0.0.16/28\"]",
        "write = [\"127.0.0.20/32\"]\noffline = \"fault\"",
    ));
    plant.site.write(
        "drivegate.conf",
        &config.replace("commands = true", "commands = false\nlisten = 5"),
    );
    plant.gateway.signal("HUP");
    plant.gateway.until_printed("reload rejected");
    plant.reload(&config);
    assert!(plant.is_locked());
    for (round, (what, without)) in without_right(&config).into_iter().enumerate() {
        // Below the slot that governs, another client has a slot with an active, which is kept if that client keeps
        // its right.
        assert_eq!(plant.bacpypes(20, &[run_at(3, false)]), [json!("done")], "{what}");
        assert!(plant.is_locked(), "{what}");
        plant.reload(&without);
        if what != "access" {
            assert!(!plant.is_locked(), "{what}");
        }
        plant.reload(&config);
        assert!(!plant.is_locked(), "the right is back, the slot is not: {what}");
        assert_eq!(slots(&plant), [], "{what}");
        let told = plant.void_events();
        assert_eq!(told.len(), round + 1, "{what}: {told:?}");
        assert!(
            told[0].contains("127.0.0.20:") && told[0].contains("priority 3"),
            "{told:?}"
        );
    }
}

#[test]
fn kept_slots_are_void_at_a_start_that_gives_no_right() {
    let mut plant = pumps("keep_priorities = true");
    let config = std::fs::read_to_string(plant.site.config()).unwrap();
    let restart = |plant: &mut Plant, config: &str| {
        plant.gateway.signal("TERM");
        assert!(plant.gateway.ended().success());
        plant.site.write("drivegate.conf", config);
        plant.gateway = plant.site.run_ready();
    };
    let mut ways = without_right(&config);
    ways.push((
        "keep_priorities",
        config.replace("keep_priorities = true", "keep_priorities = false"),
    ));
    for (round, (what, without)) in ways.into_iter().enumerate() {
        assert_eq!(plant.bacpypes(20, &[run_at(3, false)]), [json!("done")], "{what}");
        restart(&mut plant, &config);
        assert!(plant.is_locked(), "with the right it is kept: {what}");
        restart(&mut plant, &without);
        until("the event", || (plant.void_events().len() == round + 1).then_some(()));
        if what != "access" {
            assert!(!plant.is_locked(), "{what}");
        }
        restart(&mut plant, &config);
        assert!(!plant.is_locked(), "the right is back, the slot is not: {what}");
        assert_eq!(slots(&plant), [], "{what}");
    }
}

/// The first of several writes in one request waits for a slow drive; then a reload removes the right of its client.
#[test]
fn a_write_behind_another_one_needs_the_right_that_its_client_has_then() {
    let plant = pumps("");
    let config = std::fs::read_to_string(plant.site.config()).unwrap();
    for (what, without) in without_right(&config) {
        if matches!(what, "access" | "[bacnet]") {
            // The reload replaces the bus, or the server, so nothing waits any more.
            continue;
        }
        plant.drives.signal("STOP");
        let several = json!(["several", 1, ["analog-value,1", PV, 20.0, 8], [RUN, PV, true, 8]]);
        let own = format!("127.0.0.20/8:{}", free_udp_port());
        let script = root().join("tests/peers/bacnet_client.py").display().to_string();
        let mut command = Command::new(python());
        command.args([&script, &own, &plant.address(), "1001"]);
        let child = started(&mut command, std::slice::from_ref(&several));
        std::thread::sleep(Duration::from_millis(1000));
        plant.reload(&without);
        plant.drives.signal("CONT");
        let answer = answers(child, 1).remove(0);
        assert_ne!(answer, json!("done"), "{what}");
        std::thread::sleep(Duration::from_millis(300));
        assert_eq!(plant.site.point("pump-1", "running"), false, "{what}");
        plant.reload(&config);
    }
}
