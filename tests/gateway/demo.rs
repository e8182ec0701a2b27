//! `drivegate demo`, as the README promises it.

use std::process::{Command, Output};
use std::time::Duration;

use crate::support::process::{
    Running, api, drivegate, free_port, get, mbpoll_read, point, read_registers, until, until_ready, write_registers,
};
use crate::support::site::curl;
use crate::support::tools::{root, tool};

/// The number that follows `mark` in the output of the demo.
fn port(printed: &str, mark: &str) -> u16 {
    let rest = printed
        .split_once(mark)
        .unwrap_or_else(|| panic!("no `{mark}` in\n{printed}"))
        .1;
    rest.chars()
        .take_while(char::is_ascii_digit)
        .collect::<String>()
        .parse()
        .unwrap()
}

#[test]
fn everything_it_prints_works_and_ctrl_c_ends_it() {
    let mut demo = Running::drivegate(&["demo"]);
    let printed = demo.until_printed("Ctrl-C ends the demo.");
    let (http, mqtt, modbus) = (
        port(&printed, "http://127.0.0.1:"),
        port(&printed, "-h 127.0.0.1 -p "),
        port(&printed, "tcp -p "),
    );
    until_ready(http);
    let drives: Vec<serde_json::Value> = serde_json::from_str(&get(http, "/api/v1/drives").unwrap().1).unwrap();
    assert_eq!(drives.len(), 10);
    // The drives of the demo run by themselves.
    until("a drive that runs by itself", || {
        ["pump-1", "pump-2", "fan-1"]
            .into_iter()
            .find(|drive| api(http, drive)["state"] == "running")
    });

    until("the frequency of pump-1", || {
        let metrics = get(http, "/metrics")?.1;
        let wanted = "drivegate_drive_output_frequency_hertz{bus=\"line1\",drive=\"pump-1\"}";
        metrics.contains(wanted).then_some(())
    });
    let payload = "{\"run\": true, \"speed_reference\": 50}";
    // A pause of the machine makes an order expire; a client that has no answer gives it again.
    until("pump-1 at its reference", || {
        let sent = Command::new(tool("mosquitto_pub"))
            .args(["-h", "127.0.0.1", "-p", &mqtt.to_string(), "-q", "1"])
            .args(["-t", "drivegate/demo/drive/pump-1/set", "-m", payload])
            .status();
        assert!(sent.unwrap().success());
        (0..300).find_map(|_| {
            std::thread::sleep(Duration::from_millis(20));
            (point(http, "pump-1", "output_frequency") == 25.0).then_some(())
        })
    });

    // The command words of the common model work for a TECO on Modbus ASCII and for a Vacon NX on N2: 50 %, run,
    // read, stop.
    for (unit, name, half) in [(7, "conveyor-1", 3000), (8, "ahu-1", 2500)] {
        until(&format!("{name} at half speed"), || {
            // The drives of the demo have a fault now and then until they are commanded.
            if api(http, name)["state"] == "fault" {
                write_registers(modbus, unit, 33_024, &[2]);
            }
            write_registers(modbus, unit, 33_025, &[5000]);
            write_registers(modbus, unit, 33_024, &[1]);
            (0..300).find_map(|_| {
                std::thread::sleep(Duration::from_millis(20));
                let registers = mbpoll_read(modbus, unit, 32_768, 19).ok()?;
                (registers.get(1) == Some(&3) && registers.get(5) == Some(&half)).then_some(())
            })
        });
        write_registers(modbus, unit, 33_024, &[0]);
    }

    assert_eq!(read_registers(modbus, 1, 32_768, 19).get(5), Some(&2500));
    write_registers(modbus, 1, 33_024, &[0]);
    until("pump-1 stopped", || {
        (api(http, "pump-1")["state"] == "ready").then_some(())
    });

    // The login that the demo prints can start a motor as the page does, and no other login can.
    let (_, rest) = printed.split_once("user operator, password ").unwrap();
    let password = rest.split_whitespace().next().unwrap();
    let order = |password: &str, order: &str| {
        let (login, url) = (
            format!("operator:{password}"),
            format!("http://127.0.0.1:{http}/api/v1/drives/pump-1/commands"),
        );
        curl(&["-u", &login, "-d", order, &url])
    };
    assert_eq!(order("another-password", "{\"run\": true}").0, 401);
    let (status, result) = order(password, "{\"run\": true, \"speed_reference\": 30}");
    assert_eq!(status, 200, "{result}");
    until("pump-1 at its reference", || {
        (point(http, "pump-1", "output_frequency") == 15.0).then_some(())
    });
    assert_eq!(order(password, "{\"run\": false}").0, 200);
    let metrics = get(http, "/metrics").unwrap().1;
    assert!(
        metrics.contains("drivegate_listener_up{server=\"bacnet\"} 1"),
        "{metrics}"
    );

    demo.signal("INT");
    let status = demo.ended();
    assert!(status.success(), "{status}");
}

#[test]
fn a_second_demo_takes_other_ports() {
    let first = Running::drivegate(&["demo"]);
    let taken = first.until_printed("Ctrl-C ends the demo.");
    let second = Running::drivegate(&["demo"]);
    let printed = second.until_printed("Ctrl-C ends the demo.");
    for (mark, what) in [
        ("http://127.0.0.1:", "HTTP"),
        ("-h 127.0.0.1 -p ", "MQTT broker"),
        ("tcp -p ", "Modbus TCP"),
    ] {
        assert_ne!(port(&printed, mark), port(&taken, mark), "{what}");
    }
    assert!(printed.contains(" is in use; "), "it says so:\n{printed}");
    until_ready(port(&printed, "http://127.0.0.1:"));
}

/// Runs a line as if it were pasted into a shell; a command that does not end by itself is terminated.
fn pasted(line: &str) -> Output {
    let own = [".tools/venv/bin", ".tools/bin"].map(|dir| root().join(dir).display().to_string());
    let path = format!("{}:{}", own.join(":"), std::env::var("PATH").unwrap_or_default());
    let mut shell = Command::new("timeout");
    shell.args(["10", "bash", "-c", line]).env("PATH", path);
    shell.output().unwrap()
}

/// Examples that read from a gateway at its default ports, or need none; without programs that only format the output.
fn examples_of_the_pages() -> Vec<String> {
    let pages = [
        "http",
        "history",
        "modbus-tcp",
        "profiles",
        "troubleshooting",
        "commands",
    ]
    .map(|page| root().join(format!("docs/{page}.md")));
    let text = pages.map(|page| std::fs::read_to_string(page).unwrap()).concat();
    let reads = |line: &&str| {
        ["curl -s ", "mbpoll -m tcp ", "drivegate profiles"]
            .iter()
            .any(|begin| line.starts_with(begin))
            && !line.contains("curl -N")
    };
    let lines = text.lines().map(|line| line.trim_start_matches("$ ")).filter(reads);
    let lines = lines.map(|line| line.split(" | ").next().unwrap().to_string());
    let lines: Vec<String> = lines.collect();
    assert!(lines.len() >= 10, "{lines:#?}");
    lines
}

#[test]
fn every_line_that_it_prints_can_be_pasted_whole() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("my demo");
    let mut demo = Running::drivegate(&["demo", "--write-config", dir.to_str().unwrap()]);
    let printed = demo.until_printed("Ctrl-C ends the demo.");
    let http = port(&printed, "http://127.0.0.1:");
    until_ready(http);
    let lines: Vec<&str> = printed
        .lines()
        .filter_map(|line| line.strip_prefix("  ").filter(|rest| !rest.starts_with(' ')))
        .collect();
    assert!(lines.len() > 15, "{printed}");
    // The examples of the pages, which name the usual ports, work on the demo, too.
    let modbus = port(&printed, "mbpoll -m tcp -p ");
    for line in examples_of_the_pages() {
        let line = match line.strip_prefix("drivegate ") {
            Some(rest) => format!("{} {rest}", env!("CARGO_BIN_EXE_drivegate")),
            None => line,
        };
        let line = line
            .replace("127.0.0.1:9488", &format!("127.0.0.1:{http}"))
            .replace("-p 1502", &format!("-p {modbus}"));
        until(&line, || {
            let output = pasted(&line);
            (output.status.success() && !output.stdout.is_empty()).then_some(())
        });
    }
    for line in &lines {
        until(line, || {
            let output = pasted(line);
            // The command that shows topics as they arrive is ended by the time limit.
            let endless = line.starts_with("mosquitto_sub ") && output.status.code() == Some(124);
            (endless && !output.stdout.is_empty() || output.status.success()).then_some(())
        });
    }
    until("pump-1 stopped by the last of its lines", || {
        (api(http, "pump-1")["state"] == "ready").then_some(())
    });

    // The other commands find the demo by its configuration, also under another name of its directory.
    let config = dir.join("drivegate.toml").display().to_string();
    until("its values", || {
        let read = drivegate(&["read", "--config", &config, "--json", "pump-1", "state", "fault_text"])
            .output()
            .unwrap();
        let values: Vec<serde_json::Value> = serde_json::from_slice(&read.stdout).unwrap();
        (values[0]["value"] == "ready" && values[1]["value"] == "").then_some(())
    });
    let url = format!("http://127.0.0.1:{http}");
    let watched = drivegate(&["watch", "--once", "--url", &url]).output().unwrap();
    assert!(String::from_utf8_lossy(&watched.stdout).contains("ahu-3"));

    demo.signal("INT");
    assert!(demo.ended().success());
    assert!(!dir.join("line1").exists(), "the ports end with the demo");
    // A configuration that no demo has written is not touched.
    std::fs::write(&config, "[gateway]\n").unwrap();
    let refused = drivegate(&["demo", "--write-config", dir.to_str().unwrap()])
        .output()
        .unwrap();
    assert_eq!(refused.status.code(), Some(1));
    assert_eq!(std::fs::read_to_string(&config).unwrap(), "[gateway]\n");
}

#[test]
fn the_demo_of_the_compose_file_has_its_drives() {
    let config = root().join("deploy/compose/demo/drivegate.toml").display().to_string();
    let compose = std::fs::read_to_string(root().join("deploy/compose.yaml")).unwrap();
    let ports: Vec<u16> = (0..4).map(|_| free_port()).collect();
    let environment = |bus: usize| format!("DRIVEGATE__BUS__{bus}__PORT");
    let mut simulate = drivegate(&["simulate", "--config", &config, "--autopilot"]);
    let mut run = drivegate(&["run", "--config", &config]);
    let (modbus, http) = (free_port(), free_port());
    for (bus, port) in ports.iter().enumerate() {
        let given = format!("{}: tcp://0.0.0.0:400{}", environment(bus), bus + 1);
        assert!(compose.contains(&given), "compose.yaml lacks {given}");
        simulate.env(environment(bus), format!("tcp://127.0.0.1:{port}"));
        run.env(environment(bus), format!("tcp://127.0.0.1:{port}"));
    }
    run.env("DRIVEGATE__HTTP__LISTEN", format!("127.0.0.1:{http}"));
    run.env("DRIVEGATE__MODBUS_TCP__LISTEN", format!("127.0.0.1:{modbus}"));
    run.env("DRIVEGATE__MQTT__URL", "mqtt://127.0.0.1:1");
    run.env("DRIVEGATE__GATEWAY__SOCKET", "");
    let _lines = Running::spawn(&mut simulate);
    let _gateway = Running::spawn(&mut run);
    until("all drives of all families", || {
        let drives: Vec<serde_json::Value> = serde_json::from_str(&get(http, "/api/v1/drives")?.1).ok()?;
        (drives.len() == 8 && drives.iter().all(|drive| drive["online"] == true)).then_some(())
    });
}
