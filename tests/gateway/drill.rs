//! A drill with the real program: by command line and by curl, on simulated drives in a separate process.

use serde_json::{Value as Json, json};

use crate::support::process::{Running, free_port, get, until, write_registers};
use crate::support::site::{HTTP, LINE1, MODBUS_TCP, Site, USERS, controlled};
use crate::support::tools::{feed, python, root, run};

fn program() -> &'static std::path::Path {
    std::path::Path::new(env!("CARGO_BIN_EXE_drivegate"))
}

struct Plant {
    site: Site,
    others: [Running; 2],
}

fn plant() -> Plant {
    let supervised = "supervision = { timeout = \"2s\", action = \"stop\" }";
    let drives = [controlled("pump-1", 1, supervised), controlled("pump-2", 2, "")].concat();
    let drill = "[drill]\nmax_speed = 20.0\nlimit = \"8s\"\n";
    let site = Site::of(&[LINE1, &drives, MODBUS_TCP, HTTP, USERS, drill]);
    site.change(
        "[gateway]\n",
        &format!(
            "[gateway]\nstate_dir = \"{}\"\nsocket = \"{}\"\n",
            site.path("state"),
            site.path("s")
        ),
    );
    std::fs::create_dir(site.file("state")).unwrap();
    ["alice", "bob"].iter().for_each(|user| site.add_user(user));
    let simulator = site.simulate(&["--addresses", "1-2", "--baud", "38400"]);
    let gateway = site.run_ready();
    site.until_state("pump-1", "ready");
    Plant {
        site,
        others: [simulator, gateway],
    }
}

impl Plant {
    fn curl(&self, user: &str, method: &str, path: &str, body: &Json) -> (u16, Json) {
        let body = body.to_string();
        let arguments = ["-X", method, "-d", &body];
        let count = if method == "POST" { 4 } else { 2 };
        self.site.curl(user, &format!("drills{path}"), &arguments[..count])
    }

    fn ended(&self, id: &str) -> Json {
        until("the drill is over", || {
            let (_, drill) = self.curl("alice", "GET", &format!("/{id}"), &Json::Null);
            let state = drill["state"].as_str().unwrap().to_string();
            (state != "armed" && state != "running").then_some(drill)
        })
    }

    fn metrics(&self) -> String {
        get(self.site.http, "/metrics").unwrap().1
    }
}

#[test]
fn a_drill_proves_stops_and_is_kept() {
    let plant = plant();
    let site = &plant.site;
    let config = site.config();
    // The end of a drill is on disk a moment later than it is shown.
    let check = |wanted: &str| {
        until(wanted, || {
            let output = run(program(), &["check", "--config", &config]);
            let said = String::from_utf8(output.stderr).unwrap();
            let mut lines = said.lines();
            lines
                .any(|line| line.contains("not proven by a drill") && line.contains(wanted))
                .then_some(())
        });
    };
    check("pump-1 (order, client, gateway), pump-2 (order, gateway)");
    // A wrong drive name starts nothing.
    let wrong = feed(program(), &["drill", "--config", &config, "pump-1"], "pump-2\n");
    let said = String::from_utf8(wrong.stderr).unwrap();
    assert!(
        !wrong.status.success() && said.contains("the name was not typed; nothing was started"),
        "{said}"
    );
    assert_eq!(site.point("pump-1", "running"), false);
    let ran = feed(
        program(),
        &[
            "drill", "--config", &config, "pump-1", "--order", "--client", "--speed", "10",
        ],
        "pump-1\n",
    );
    let said = String::from_utf8(ran.stderr.clone()).unwrap();
    assert!(ran.status.success(), "{said}");
    assert!(
        said.contains("the client is silent") && said.contains("the motor stopped in time each way"),
        "{said}"
    );
    check("pump-1 (gateway), pump-2 (order, gateway)");
    let metrics = plant.metrics();
    for kind in ["order", "client"] {
        let passed = metrics
            .lines()
            .find(|line| line.starts_with("drivegate_drill_passed") && line.contains(kind));
        assert!(
            passed.is_some_and(|line| line.contains("pump-1") && line.ends_with(" 1")),
            "{metrics}"
        );
        assert!(metrics.contains("drivegate_drill_age_seconds{"));
    }
    let (_, drills) = plant.curl("alice", "GET", "", &Json::Null);
    let steps = drills[0]["steps"].as_array().unwrap();
    assert_eq!((&drills[0]["state"], steps.len()), (&json!("passed"), 2), "{drills}");
    let took = |step: usize| steps[step]["took_ms"].as_u64().unwrap();
    assert!(took(0) < 8_000 && (2_000..8_000).contains(&took(1)), "{drills}");
    let id = drills[0]["id"].as_str().unwrap();
    let report = run(program(), &["drill", "report", "--config", &config, id]);
    let page = String::from_utf8(report.stdout).unwrap();
    assert!(
        page.starts_with("<!doctype html>") && page.contains("Drill of drive pump-1"),
        "{page}"
    );
    // The drill is known after a restart, and is in the audit.
    let of_drill = |record: &Json| {
        record["command"]
            .as_str()
            .is_some_and(|command| command.starts_with("drill order, client"))
    };
    assert!(
        site.audit()
            .iter()
            .any(|record| of_drill(record) && record["result"] == "passed")
    );
    drop(plant.others);
    check("pump-1 (gateway), pump-2 (order, gateway)");
}

#[test]
fn what_ends_a_drill_is_named_and_the_motor_is_stopped() {
    let plant = plant();
    let site = &plant.site;
    let begin = |kinds: Json| {
        let (status, armed) = plant.curl(
            "alice",
            "POST",
            "",
            &json!({"drive": "pump-1", "kinds": kinds, "speed": 10}),
        );
        assert_eq!((status, &armed["state"]), (201, &json!("armed")), "{armed}");
        let id = armed["id"].as_str().unwrap().to_string();
        // Only the user who armed the drill may start it.
        let (status, refused) = plant.curl("bob", "POST", &format!("/{id}/start"), &json!({}));
        assert_eq!(status, 409, "{refused}");
        let (status, started) = plant.curl("alice", "POST", &format!("/{id}/start"), &json!({}));
        assert_eq!(status, 200, "{started}");
        site.until_point("pump-1", "running", true);
        id
    };
    let stands = |id: &str, state: &str, text: &str| {
        let drill = plant.ended(id);
        assert_eq!(drill["state"], state, "{drill}");
        assert!(drill["text"].as_str().unwrap().contains(text), "{text}: {drill}");
        assert_eq!(drill["last_stop"], "acknowledged", "{drill}");
        site.until_point("pump-1", "running", false);
        site.until_state("pump-1", "ready");
    };
    // A PLC stops the motor; in the next drill, a PLC writes another command.
    let id = begin(json!(["gateway"]));
    write_registers(site.modbus, 1, 0x8100, &[0]);
    stands(&id, "aborted", "modbus_tcp 127.0.0.1");
    let id = begin(json!(["gateway"]));
    let refused = crate::support::process::mbpoll_write(site.modbus, 1, 0x8101, &[1500]);
    assert!(refused.is_err());
    stands(&id, "aborted", "sent a command: speed_reference=15");
    // Any user who may command can end the drill.
    let id = begin(json!(["order", "gateway"]));
    assert_eq!(plant.curl("bob", "DELETE", &format!("/{id}"), &Json::Null).0, 200);
    stands(&id, "aborted", "http bob 127.0.0.1 ended it");
    // With factory settings the simulated drive does not react to a silent master: the drill must report that.
    let id = begin(json!(["gateway"]));
    stands(&id, "failed", "after a silence of 8 s the motor still turns");
    // A drive that cannot pass is refused before anything starts, and the gateway's end stops the motor.
    for (body, text) in [
        (json!({"drive": "pump-2", "kinds": ["client"]}), "has no supervision"),
        (
            json!({"drive": "pump-1", "speed": 21}),
            "allowed are more than 0 to 20 %",
        ),
        (json!({"drive": "pump-1", "kinds": ["all"]}), "the body is"),
    ] {
        let (status, refused) = plant.curl("alice", "POST", "", &body);
        assert_eq!(status, 422, "{refused}");
        assert!(refused["error"].as_str().unwrap().contains(text), "{refused}");
    }
    // A reload that removes the drive stops the drive's motor first.
    let id = begin(json!(["gateway"]));
    let supervised = "supervision = { timeout = \"2s\", action = \"stop\" }";
    site.change(&controlled("pump-1", 1, supervised), "");
    plant.others[1].signal("HUP");
    let drill = plant.ended(&id);
    assert_eq!(
        (&drill["state"], &drill["last_stop"]),
        (&json!("aborted"), &json!("acknowledged")),
        "{drill}"
    );
    assert!(
        drill["text"].as_str().unwrap().contains("a reload of its bus"),
        "{drill}"
    );
}

#[test]
fn a_gateway_killed_in_a_drill_stops_the_motor_when_it_is_back() {
    let mut plant = plant();
    let wish = json!({"drive": "pump-2", "kinds": ["gateway"], "speed": 10});
    let (status, armed) = plant.curl("alice", "POST", "", &wish);
    assert_eq!(status, 201, "{armed}");
    let id = armed["id"].as_str().unwrap().to_string();
    let (status, started) = plant.curl("alice", "POST", &format!("/{id}/start"), &json!({}));
    assert_eq!(status, 200, "{started}");
    plant.site.until_point("pump-2", "running", true);
    plant.others[1].signal("KILL");
    plant.others[1].ended();
    plant.others[1] = plant.site.run_ready();
    let drill = plant.ended(&id);
    assert_eq!(
        (&drill["state"], &drill["last_stop"]),
        (&json!("aborted"), &json!("acknowledged")),
        "{drill}"
    );
    let text = drill["text"].as_str().unwrap();
    assert!(
        text.contains("the gateway was killed or lost power during it"),
        "{drill}"
    );
    plant.site.until_point("pump-2", "running", false);
    until("the end of the drill on disk", || {
        let text = std::fs::read_to_string(plant.site.file("state/drills.json")).ok()?;
        text.contains("\"aborted\"").then_some(())
    });
    // The next start finds nothing to stop.
    plant.others[1].signal("KILL");
    plant.others[1].ended();
    plant.others[1] = plant.site.run_ready();
    assert_eq!(plant.curl("alice", "GET", &format!("/{id}"), &Json::Null).1, drill);
}

/// A drive in Python whose own timeout counts only writes: the drill feeds it until it falls silent, then the drive stops by
/// itself, and that proves the whole chain.
fn passes_by_its_own_timeout(profile: &str, peer: &str) {
    let port = free_port().to_string();
    let drives = root().join("tests/peers/families/run.py").display().to_string();
    let drive = Running::start(&python(), &[&drives, peer, &port, "timeout=6"]);
    drive.until_printed("ready");
    let bus = LINE1.replace("port = \"line1\"", &format!("port = \"tcp://127.0.0.1:{port}\""));
    let supervised = "supervision = { timeout = \"1min\", action = \"stop\" }";
    let pump = controlled("pump-1", 1, supervised).replace("vacon-nx", profile);
    let site = Site::of(&[&bus, &pump, HTTP, "[drill]\nmax_speed = 20.0\nlimit = \"12s\"\n"]);
    let state = site.path("state");
    std::fs::create_dir(&state).unwrap();
    let place = format!("[gateway]\nstate_dir = \"{state}\"\nsocket = \"{}\"\n", site.path("s"));
    site.change("[gateway]\n", &place);
    let _gateway = site.run_ready();
    until("the drive is ready", || {
        (site.point("pump-1", "running") == false && site.point("pump-1", "fault") == false).then_some(())
    });
    let config = site.config();
    let arguments = ["drill", "--config", &config, "pump-1", "--gateway", "--speed", "10"];
    let ran = feed(program(), &arguments, "pump-1\n");
    let said = String::from_utf8(ran.stderr).unwrap();
    let did = drive.output();
    assert!(ran.status.success(), "{profile}: {said}\n{did}");
    assert!(said.contains("nothing is sent"), "{profile}: {said}");
    let count = |text: &str| did.matches(text).count();
    assert_eq!(
        (count("motor forward"), count("own timeout")),
        (1, 1),
        "{profile}: {did}"
    );
}

#[test]
fn a_drill_of_the_gateway_proves_a_timeout_that_counts_words() {
    passes_by_its_own_timeout("danfoss-fc", "danfoss");
}

#[test]
fn a_drill_of_the_gateway_proves_a_timeout_that_counts_references() {
    passes_by_its_own_timeout("abb-acs580", "abb");
}
