//! Engineering Data Transaction, version 2: the table of all objects for the tool of an integrator, with the tables of
//! states and units next to it. Pure.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use drivegate_bacnet::{Access, Kind, Object};

use super::objects::ListedDevice;
use super::units;

/// The three files of an EDE export.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Ede {
    pub objects: String,
    pub state_texts: String,
    pub units: String,
}

/// A field of the EDE file, in quotes where the format requires them.
fn field(text: &str) -> String {
    let text = text.replace(['\n', '\r'], " ");
    if text.contains([';', '"']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text
    }
}

/// The texts of the states of an object.
fn states(object: &Object) -> Option<Vec<String>> {
    match &object.kind {
        Kind::Binary { texts } => Some(texts.iter().map(|text| text.to_string()).collect()),
        Kind::MultiState { texts } => Some(texts.to_vec()),
        Kind::Analog { .. } | Kind::Text => None,
    }
}

/// The tables of these devices; `project` names the configuration.
pub fn tables(project: &str, devices: &[ListedDevice]) -> Ede {
    let mut references: BTreeMap<Vec<String>, usize> = BTreeMap::new();
    let mut ordered: Vec<Vec<String>> = Vec::new();
    let mut rows = String::new();
    for shown in devices {
        let device = &shown.device;
        let own = (&device.name, "device", &device.description);
        let _ = writeln!(
            rows,
            "{};{};{};8;{};{};;;;N;N;;;;;;",
            field(own.0),
            device.instance,
            field(&device.name),
            device.instance,
            field(own.2)
        );
        for object in device.objects() {
            let reference = states(object).map(|texts| {
                let next = references.len() + 1;
                *references.entry(texts.clone()).or_insert_with(|| {
                    ordered.push(texts);
                    next
                })
            });
            let (range, unit, increment) = match &object.kind {
                Kind::Analog {
                    units,
                    range,
                    increment,
                    ..
                } => (*range, Some(*units), Some(*increment)),
                _ => (None, None, None),
            };
            let text = |number: Option<f32>| number.map_or(String::new(), |number| number.to_string());
            let yes = |is: bool| if is { "Y" } else { "N" };
            let cells = [
                field(&format!("{}.{}", device.name, object.name)),
                device.instance.to_string(),
                field(&object.name),
                object.id.kind.0.to_string(),
                object.id.instance.to_string(),
                field(&object.description),
                String::new(),
                text(range.map(|(low, _)| low)),
                text(range.map(|(_, high)| high)),
                yes(object.access == Access::Command).to_string(),
                yes(object.access != Access::Read).to_string(),
                "Y".to_string(),
                text(increment),
                reference.map_or(String::new(), |number| number.to_string()),
                unit.map_or(String::new(), |number| number.to_string()),
                String::new(),
                String::new(),
            ];
            let _ = writeln!(rows, "{}", cells.join(";"));
        }
    }
    let columns = "#Keyname;device obj.-instance;object-name;object-type;object-instance;description;present-value-default;\
                   min-present-value;max-present-value;commandable;settable;supports COV;COV-increment;state-text-reference;\
                   unit-code;vendor-specific-address;notification-class";
    let objects = format!(
        "#Engineering-Data-Exchange - B.I.G.-EU\nPROJECT_NAME;{}\nVERSION_OF_REFERENCEFILE;1\nTIMESTAMP_OF_LAST_CHANGE;\n\
         AUTHOR_OF_LAST_CHANGE;drivegate\nVERSION_OF_LAYOUT;2.3\n#mandatory;mandatory;mandatory;mandatory;mandatory;optional;\
         optional;optional;optional;optional;optional;optional;optional;optional;optional;optional;optional\n{columns}\n{rows}",
        field(project)
    );
    let most = ordered.iter().map(Vec::len).max().unwrap_or(0);
    let numbers = (1..=most).map(|state| format!(";Text {state}"));
    let mut state_texts = format!(
        "#State Text Reference\n#Reference Number{}\n",
        numbers.collect::<String>()
    );
    for (number, texts) in (1..).zip(&ordered) {
        let texts: Vec<String> = texts.iter().map(|text| field(text)).collect();
        let _ = writeln!(state_texts, "{number};{}", texts.join(";"));
    }
    let mut unit_table = "#Encoding of BACnet Engineering Units\n#Code;Unit Text\n".to_string();
    for (number, unit) in units::all() {
        let _ = writeln!(unit_table, "{number};{unit}");
    }
    Ede {
        objects,
        state_texts,
        units: unit_table,
    }
}
