//! Parameters of the families: read from one drive in Python and restored to another at which somebody had changed some. Places
//! and values are by hand.

use drivegate_testkit::rows;

use crate::support::process::{Running, drivegate, free_port, until};
use crate::support::site::{HTTP, Site};
use crate::support::tools::{python, root};

/// Profile and peer, a line of the file as `id value text`, what was changed at the second drive, the writes it gets, and the
/// registers that are left as they are because their parameters are restored by name only.
const CASES: &str = "\
abb-acs550        | abb     | 2202 50 5.0 s     | 2201:20 2007:400 9905:99 3017:3 1000:1       | 0899=0032 07D7=01F4 26B1=0043 0646=0001 | 0BC9 03E8
danfoss-fc        | danfoss | 4-14 500 50.0 Hz  | 4139:300 1229:60                             | 102B=01F4 04CD=0032                     |
delta-ms300       | delta   | 01-00 6000 60.00 Hz | 0x0100:5000 0x010C:500 0x0902:1            | 0100=1770 010C=03E8                     | 0902
hitachi-wj200     | hitachi | A004 500 50.0 Hz  | 0x1202:300 0x1203:400 0x1201:2               | 1202=01F4 1203=01F4 08FF=0001           | 1201
invt-goodrive     | invt    | P00.11 100 10.0 s | 0x000B:50 0x0003:6000 0x0001:0               | 000B=0064 0003=1388                     | 0001
schneider-altivar | cia402  | HSP 500 50.0 Hz   | 3104:400 3105:100 9001:80 9603:44 8413:1     | 0C20=01F4 0C21=0000 2329=001E 2583=0034 | 20DD
siemens-v20       | siemens | 40011 1000 10.00 s | 10:500 9:2000 0:9 15:6000                   | 000A=03E8 0009=05DC                     | 0000 000F
vacon-10          | vacon10 | 102 5000 50.00 Hz | 101:4000 102:50 171:1                        | 0065=1388 0066=001E                     | 00AB
weg-cfw           | weg     | P0100 200 20.0 s  | 100:50 134:300 401:99 313:4 222:1            | 0064=00C8 0086=0294 0191=0047           | 0139 00DE";

/// A drive in Python that somebody has set so.
fn drive(peer: &str, port: u16, changed: &str) -> Running {
    let program = root().join("tests/peers/families/run.py").display().to_string();
    let port = port.to_string();
    let set: Vec<String> = changed.split_whitespace().map(|one| format!("set={one}")).collect();
    let mut arguments = vec![program.as_str(), peer, &port];
    arguments.extend(set.iter().map(String::as_str));
    let drive = Running::start(&python(), &arguments);
    drive.until_printed("ready");
    drive
}

fn bus(name: &str, port: u16, profile: &str, keys: &str) -> String {
    format!(
        "[[bus]]\nname = \"line-{name}\"\nport = \"tcp://127.0.0.1:{port}\"\nbaud = 38400\nsilence = \"chars\"\n\
         response_timeout = \"2s\"\ncycle = \"200ms\"\n[[bus.drive]]\nname = \"{name}\"\naddress = 1\nprofile = \"{profile}\"\n{keys}"
    )
}

/// Runs `drivegate params`; returns its exit code and all that it printed.
fn params(site: &Site, arguments: &[&str]) -> (Option<i32>, String) {
    let config = site.config();
    let output = drivegate(&[&["params"], arguments, &["--config", &config]].concat())
        .output()
        .unwrap();
    let text = [output.stdout, output.stderr].concat();
    (output.status.code(), String::from_utf8(text).unwrap())
}

fn goes_from_drive_to_drive(row: [&'static str; 6]) {
    let [profile, peer, line, changed, written, left] = row;
    let ports = [free_port(), free_port()];
    let (one, two) = (drive(peer, ports[0], ""), drive(peer, ports[1], changed));
    let site = Site::new();
    let gateway = format!(
        "[gateway]\nname = \"test\"\nstate_dir = \"state\"\nsocket = \"{}\"\n",
        site.path("socket")
    );
    let writable = "access = \"control\"\nparams = \"write\"\n";
    let buses = [
        bus("one", ports[0], profile, ""),
        bus("two", ports[1], profile, writable),
    ]
    .concat();
    site.configure(&[&gateway, &buses, HTTP]);
    let _gateway = site.run_ready();

    let file = site.path("one.params");
    let (code, said) = params(&site, &["read", "one", "-o", &file]);
    assert_eq!(code, Some(0), "{profile}: {said}");
    let text = std::fs::read_to_string(&file).unwrap();
    let (id, value) = line.split_once(' ').unwrap();
    let (raw, value) = value.split_once(' ').unwrap();
    let has = |found: &str| {
        let [name, counts, shown] = found.splitn(3, ['=', '#']).map(str::trim).collect::<Vec<_>>()[..] else {
            return false;
        };
        (name, counts) == (id, raw) && shown.starts_with(value)
    };
    assert!(text.lines().any(has), "{profile}: {text}");
    assert!(!text.contains("= ?"), "{profile}: {text}");

    let (code, said) = params(&site, &["restore", &file, "two", "--force", "--yes"]);
    assert_eq!(code, Some(0), "{profile}: {said}");
    for write in written.split_whitespace() {
        let (register, value) = write.split_once('=').unwrap();
        let seen = format!("wrote holding {register} {value}\n");
        until(&seen, || two.output().contains(&seen).then_some(()));
        let register = format!("wrote holding {register} ");
        assert_eq!(two.output().matches(&register).count(), 1, "{profile}: {register}");
    }
    let writes = two.output().matches("wrote holding").count();
    assert_eq!(
        writes,
        written.split_whitespace().count(),
        "{profile}: {}",
        two.output()
    );
    assert!(!one.output().contains("wrote"), "{profile}: {}", one.output());

    let (code, differs) = params(&site, &["diff", &file, "two"]);
    let left = left.split_whitespace().count();
    assert_eq!(code, Some(i32::from(left > 0)), "{profile}: {differs}");
    assert_eq!(differs.matches(" → ").count(), left, "{profile}: {differs}");
}

fn every_third(first: usize) {
    for row in rows::<6>(CASES).into_iter().skip(first).step_by(3) {
        println!("{}", row[0]);
        goes_from_drive_to_drive(row);
    }
}

#[test]
fn parameters_go_from_drive_to_drive_1() {
    every_third(0);
}

#[test]
fn parameters_go_from_drive_to_drive_2() {
    every_third(1);
}

#[test]
fn parameters_go_from_drive_to_drive_3() {
    every_third(2);
}
