//! The changes of a reload, as text. Pure.

use crate::config::Settings;

/// Lines that describe what `after` has and `before` had not; empty if the two are equal.
pub(super) fn between(before: &Settings, after: &Settings) -> Vec<String> {
    let mut changes = buses(before, after);
    let values = [
        ("the name of the gateway", before.gateway == after.gateway),
        ("stale_after", before.stale_after == after.stale_after),
        ("the local socket", before.socket == after.socket),
        ("what the recorder keeps", before.recordings == after.recordings),
        ("how parameters are read", before.params == after.params),
        ("the log level", before.log.level == after.log.level),
    ];
    let sections = [
        section("Modbus TCP", &before.modbus_tcp, &after.modbus_tcp),
        section("the tool slots", &before.slots, &after.slots),
        section("MQTT", &before.mqtt, &after.mqtt),
        section("HTTP", &before.http, &after.http),
        section("BACnet/IP", &before.bacnet, &after.bacnet),
        section("who holds drives", &before.authority, &after.authority),
        section("drills", &before.drill, &after.drill),
        section("the audit file", &before.audit, &after.audit),
    ];
    changes.extend(sections.into_iter().flatten());
    let changed = values.into_iter().filter(|(_, same)| !same);
    changes.extend(changed.map(|(what, _)| format!("changed: {what}")));
    if before.log.format != after.log.format {
        changes.push("the log format changes at the next start".to_string());
    }
    changes
}

fn buses(before: &Settings, after: &Settings) -> Vec<String> {
    let mut changes = Vec::new();
    for bus in &after.buses {
        let name = &bus.spec.name;
        match before.buses.iter().find(|old| old.spec.name == *name) {
            None => changes.push(format!("started: bus `{name}`")),
            Some(old) if old != bus => changes.push(format!("changed: bus `{name}`, restarted")),
            Some(_) => {}
        }
    }
    let gone = |name: &str| after.buses.iter().all(|bus| bus.spec.name != name);
    let removed = before.buses.iter().map(|bus| &bus.spec.name).filter(|name| gone(name));
    changes.extend(removed.map(|name| format!("stopped: bus `{name}`")));
    changes
}

fn section<T: PartialEq>(name: &str, before: &Option<T>, after: &Option<T>) -> Option<String> {
    let what = match (before, after) {
        (None, Some(_)) => "started",
        (Some(_), None) => "stopped",
        (before, after) if before != after => "changed",
        _ => return None,
    };
    Some(format!("{what}: {name}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings(text: &str) -> Settings {
        let text = format!("[gateway]\nname = \"g\"\n{text}");
        Settings::parse("t.toml", &text, std::iter::empty()).settings.unwrap()
    }

    #[test]
    fn only_what_differs_is_named() {
        let bus =
            |name: &str, baud: u32| format!("[[bus]]\nname = \"{name}\"\nport = \"/dev/{name}\"\nbaud = {baud}\n");
        let http = "[http]\nlisten = \"127.0.0.1:0\"\n";
        let before = settings(&(bus("a", 9600) + &bus("b", 9600) + &bus("c", 9600) + http));
        assert!(between(&before, &before).is_empty());
        let after =
            settings(&(bus("d", 9600) + &bus("a", 9600) + &bus("b", 19200) + "[mqtt]\n[log]\nlevel = \"warn\"\n"));
        assert_eq!(
            between(&before, &after),
            [
                "started: bus `d`",
                "changed: bus `b`, restarted",
                "stopped: bus `c`",
                "started: MQTT",
                "stopped: HTTP",
                "changed: the log level",
            ]
        );
    }
}
