use std::time::Duration;

use drivegate_testkit::{STALE_AFTER, bus, bus_spec, image, monitored, nx};

use super::export::quoted;
use super::*;
use drivegate_core::process_image::Access;
use drivegate_north::modbus_tcp::Registers;

fn plant() -> Plant {
    let profile = nx();
    let drive = |name: &str, unit, access| {
        image(DriveSpec {
            access,
            turnaround: Duration::ZERO,
            ..monitored(name, "line1", unit, &profile)
        })
    };
    let drives = vec![drive("pump-1", 1, Access::Control), drive("pump-2", 2, Access::Monitor)];
    Plant::new("pump-house", STALE_AFTER, vec![bus(bus_spec("line1"), drives)])
}

#[test]
fn csv_has_one_line_a_register() {
    let csv = render(&plant(), &[], &View::default(), Format::Csv);
    let mut lines = csv.lines();
    let columns = lines.next().unwrap().split(',').count();
    assert_eq!(columns, 16);
    for wanted in [
        "1,pump-1,common,\"holding, input\",32772,0x8004,432773,1,actual_speed,i16,0.01,%,0x8000,read,\"holding 2102, polled fast\",",
        "1,pump-1,common,\"holding, input\",32781,0x800D,432782,2,energy,u32,1,kWh,0xFFFFFFFF,read,none,\
         never available: this family lacks it",
        "1,pump-1,command,\"holding, input\",33025,0x8101,433026,1,speed_reference,i16,0.01,%,0x8000,\"read, write\",\"holding 2002, polled slow\",",
        "2,pump-2,command,\"holding, input\",33025,0x8101,433026,1,speed_reference,i16,0.01,%,0x8000,read,\"holding 2002, polled slow\",",
        "1,pump-1,float,\"holding, input\",33282,0x8202,433283,2,output_frequency,f32,1,Hz,NaN,read,\"holding 2103, polled fast\",",
        "1,pump-1,raw,\"holding, input\",2103,0x0837,402104,1,output_frequency,i16,0.01,Hz,,read,polled fast,",
        "255,,gateway,\"input, holding\",3,0x0003,300004,1,line1: line load,u16,0.1,%,0xFFFF,read,gateway,",
    ] {
        assert!(csv.lines().any(|line| line == wanted), "{wanted} is missing in\n{csv}");
    }
}

#[test]
fn text_tells_units_and_each_profile_once() {
    let text = render(&plant(), &[], &View::default(), Format::Text);
    assert!(
        text.contains("\nProfile vacon-nx (Vacon NX, OPTC2/OPTC8 board, Modbus RTU), units 1, 2\n"),
        "{text}"
    );
    assert_eq!(text.matches("Profile vacon-nx").count(), 1);
    assert!(text.contains("monitor: every write is refused"));
    assert!(
        text.lines().all(|line| line == line.trim_end()),
        "no blanks at line ends"
    );
}

#[test]
fn fields_are_quoted_where_they_must() {
    assert_eq!(quoted("a"), "a");
    assert_eq!(quoted("a \"b\", c"), "\"a \"\"b\"\", c\"");
}

#[test]
fn json_says_what_the_csv_says() {
    let listener = Listener {
        addresses: vec!["127.0.0.1:1802".parse().unwrap()],
        tls: true,
        view: View::default(),
        writers: "role operator".to_string(),
    };
    let json = render(&plant(), &[listener], &View::default(), Format::Json);
    let json: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!(json["listeners"][0]["addresses"][0], "127.0.0.1:1802");
    assert_eq!(
        (&json["units"][1]["unit"], &json["units"][1]["access"]),
        (&2.into(), &"monitor".into())
    );
    let registers = json["registers"].as_array().unwrap();
    let csv = render(&plant(), &[], &View::default(), Format::Csv);
    assert_eq!(registers.len(), csv.lines().count() - 1);
    let current = registers
        .iter()
        .find(|r| r["unit"] == 2 && r["address"] == 0x8007)
        .unwrap();
    let wanted = serde_json::json!({
        "unit": 2, "drive": "pump-2", "view": "common", "table": "holding, input", "address": 0x8007, "hex": "0x8007",
        "reference": "432776", "registers": 1, "name": "motor_current", "type": "i16", "scale": "0.1",
        "engineering_unit": "A", "not_available": "0x8000", "access": "read", "source": "holding 2105, polled fast",
        "note": "",
    });
    assert_eq!(*current, wanted);
}

#[test]
fn a_listener_shows_its_buses() {
    let csv = |names: &[&str]| {
        let names: Vec<String> = names.iter().map(|n| n.to_string()).collect();
        let view = View {
            buses: Some(names),
            ..View::default()
        };
        render(&plant(), &[], &view, Format::Csv)
    };
    assert_eq!(csv(&["line1"]), render(&plant(), &[], &View::default(), Format::Csv));
    assert_eq!(csv(&["line2"]).lines().count(), 1);
}

#[test]
fn a_view_moves_or_hides_registers() {
    let shown = |registers, default_drive: Option<&str>| {
        let view = View {
            registers,
            default_drive: default_drive.map(str::to_string),
            ..View::default()
        };
        let csv = render(&plant(), &[], &view, Format::Csv);
        csv.lines()
            .skip(1)
            .filter(|line| !line.starts_with("2,"))
            .map(str::to_string)
            .collect::<Vec<_>>()
    };
    let zero = shown(Registers::ModelAtZero, Some("pump-1"));
    for wanted in [
        "1,pump-1,common,\"holding, input\",4,0x0004,400005,1,actual_speed,",
        "1,pump-1,command,\"holding, input\",273,0x0111,400274,1,speed_reference,",
        "1,pump-1,float,\"holding, input\",514,0x0202,400515,2,output_frequency,",
        "1,pump-1,raw,\"holding, input\",2103,0x0837,402104,1,output_frequency,",
    ] {
        assert!(zero.iter().any(|line| line.starts_with(wanted)), "{wanted}: {zero:?}");
    }
    assert!(
        zero.iter().all(|line| !line.contains(",gateway,\"input")),
        "the gateway is at no unit"
    );
    let raw = shown(Registers::Raw, None);
    assert!(
        raw.iter()
            .all(|line| line.contains(",raw,") || line.starts_with("255,")),
        "{raw:?}"
    );
}
