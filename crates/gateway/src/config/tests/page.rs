//! The tables of `docs/configuration.md`, made from the keys.

use crate::config::keys::documentation;

/// `page`, with the first table of each section generated again.
fn with_tables(page: &str) -> String {
    let sections = [
        ("[gateway]", "Gateway"),
        ("[[bus]]", "Bus"),
        ("[[bus.drive]]", "Drive"),
        ("[bus.drive.supervision]", "Supervision"),
        ("[bus.drive.guard]", "GuardTable"),
        ("[[bus.drive.interlocks]]", "InterlockTable"),
        ("[[bus.drive.trigger]]", "Trigger"),
        ("[[bus.slot]]", "SlotTable"),
        ("[modbus_tcp]", "ModbusTcp"),
        ("[[modbus_tcp.listener]]", "Listener"),
        ("[modbus_tcp.tls]", "Tls"),
        ("[mqtt]", "Mqtt"),
        ("[mqtt.qos]", "MqttQos"),
        ("[mqtt.publish]", "Publish"),
        ("[mqtt.buffer]", "Buffer"),
        ("[mqtt.home_assistant]", "MqttHomeAssistant"),
        ("[mqtt.sparkplug]", "Sparkplug"),
        ("[http]", "Http"),
        ("[bacnet]", "Bacnet"),
        ("[authority]", "AuthorityTable"),
        ("[drill]", "DrillTable"),
        ("[[authority.principal]]", "PrincipalTable"),
        ("[audit]", "AuditTable"),
        ("[recordings]", "Recordings"),
        ("[params]", "Params"),
        ("[log]", "Log"),
    ];
    let mut page = page.to_string();
    let tables = documentation();
    for (section, table) in sections {
        let rows = &tables[table];
        let heading = page.find(&format!("## `{section}`")).expect(section);
        let start = heading + page[heading..].find("\n|").expect(section) + 1;
        let end = start + page[start..].find("\n\n").map_or(page.len() - start, |end| end + 1);
        let rows: String = rows.iter().map(|row| format!("|{}|\n", row.join("|"))).collect();
        let table = format!("|key|default|what to write|meaning|\n|---|---|---|---|\n{rows}");
        page.replace_range(start..end, &table);
    }
    page
}

/// With `DRIVEGATE_WRITE_DOCS=1` the test writes the page instead of comparing it.
#[test]
fn the_page_is_made_from_the_keys() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/configuration.md");
    let page = std::fs::read_to_string(path).unwrap();
    let wanted = with_tables(&page);
    if std::env::var_os("DRIVEGATE_WRITE_DOCS").is_some() {
        std::fs::write(path, wanted).unwrap();
    } else {
        assert!(
            page == wanted,
            "docs/configuration.md is out of date; run DRIVEGATE_WRITE_DOCS=1 cargo test -p drivegate-gateway the_page_is_made"
        );
    }
}
