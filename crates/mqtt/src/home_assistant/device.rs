//! A Home Assistant device and its message: the gateway with the health of its buses, or a drive.

use serde_json::{Map, Value, json};

use super::entity::{self, Entities, extend};
use super::{Sources, id_of};
use drivegate_core::plant::{DriveHandle, Plant};

/// Manufacturers with whose names titles of profiles begin.
const MANUFACTURERS: [&str; 18] = [
    "ABB",
    "Danfoss",
    "Delta",
    "Eaton",
    "Fuji",
    "Hitachi",
    "INVT",
    "Invertek",
    "LS",
    "Lenze",
    "Mitsubishi",
    "Schneider",
    "Siemens",
    "TECO",
    "Toshiba",
    "Vacon",
    "WEG",
    "Yaskawa",
];

/// A device as Home Assistant sees it.
#[derive(Debug)]
pub(super) struct Device {
    id: String,
    kind: Kind,
}

#[derive(Debug)]
enum Kind {
    /// The gateway itself, with its name and the names of its buses.
    Gateway { name: String, buses: Vec<String> },
    /// A drive, with the id of its gateway.
    Drive { drive: DriveHandle, gateway: String },
}

impl Device {
    pub(super) fn gateway(id: &str, plant: &Plant) -> Device {
        let name = |bus: &drivegate_core::plant::BusHandle| bus.image.spec.name.clone();
        Device {
            id: id.to_string(),
            kind: Kind::Gateway {
                name: plant.gateway.clone(),
                buses: plant.buses.iter().map(name).collect(),
            },
        }
    }

    /// A drive of the gateway with this id.
    pub(super) fn drive(gateway: &str, sources: &Sources, drive: DriveHandle) -> Device {
        let topic = format!("{}/drive/{}", sources.topics.root(), drive.image.spec.name);
        Device {
            id: id_of(&topic),
            kind: Kind::Drive {
                drive,
                gateway: gateway.to_string(),
            },
        }
    }

    /// Id of the device, unique on the broker.
    pub(super) fn id(&self) -> &str {
        &self.id
    }

    /// The message, in as many parts as `limit`, the largest payload, requires; each part describes the device and
    /// some of its entities. An entity that exceeds the limit alone is a separate part.
    pub(super) fn payloads(&self, sources: &Sources, limit: usize) -> Vec<Vec<u8>> {
        let (head, entities) = match &self.kind {
            Kind::Gateway { name, buses } => (
                self.head(sources, name, ("drivegate", "gateway"), None),
                entity::of_gateway(sources, &self.id, buses),
            ),
            Kind::Drive { drive, gateway } => {
                let spec = &drive.image.spec;
                let title = spec.profile.described();
                let mut head = self.head(sources, &spec.name, made(&title), Some(gateway));
                extend(
                    &mut head,
                    json!({ "avty": entity::of_drive_availability(sources, spec) }),
                );
                (head, entity::of_drive(sources, &self.id, spec))
            }
        };
        parts(&head, entities, limit)
    }

    fn head(&self, sources: &Sources, name: &str, (manufacturer, model): (&str, &str), gateway: Option<&str>) -> Value {
        let version = drivegate_core::version::VERSION;
        let mut device = match gateway {
            Some(gateway) => json!({ "ids": [self.id], "name": name, "mdl": model, "via_device": gateway }),
            None => json!({ "ids": [self.id], "name": name, "mdl": model, "sw": version }),
        };
        if !manufacturer.is_empty() {
            extend(&mut device, json!({ "mf": manufacturer }));
        }
        json!({
            "dev": device,
            "o": { "name": "drivegate", "sw": version },
            "avty": entity::of_gateway_availability(sources),
            "avty_mode": "all",
        })
    }
}

/// Manufacturer and model by the title of a profile; Home Assistant shows "NX by Vacon".
pub(super) fn made(title: &str) -> (&str, &str) {
    let by = |manufacturer: &&str| {
        title
            .strip_prefix(manufacturer)
            .is_some_and(|rest| rest.starts_with(' '))
    };
    match MANUFACTURERS.into_iter().find(by) {
        Some(manufacturer) => (manufacturer, title.get(manufacturer.len() + 1..).unwrap_or_default()),
        None => ("", title),
    }
}

/// The entities with the head, in payloads of at most `limit` bytes as far as possible.
fn parts(head: &Value, entities: Entities, limit: usize) -> Vec<Vec<u8>> {
    let render = |entities: Map<String, Value>| {
        let mut message = head.clone();
        extend(&mut message, json!({ "cmps": entities }));
        message.to_string().into_bytes()
    };
    let empty = render(Map::new()).len();
    let mut payloads = Vec::new();
    let (mut part, mut size) = (Map::new(), empty);
    for (key, entity) in entities {
        // Length including quotes, colon and comma.
        let more = key.len() + entity.to_string().len() + 4;
        if size + more > limit && !part.is_empty() {
            payloads.push(render(std::mem::take(&mut part)));
            size = empty;
        }
        size += more;
        part.insert(key, entity);
    }
    payloads.push(render(part));
    payloads
}
