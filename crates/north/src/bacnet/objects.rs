//! The objects of a drive and of the gateway (`docs/bacnet.md`). The numbers are fixed: object n means the same
//! point of every drive. A point that a family lacks leaves a gap in the numbers. Pure.

use std::ops::RangeInclusive;
use std::sync::Arc;

use drivegate_bacnet::{Access as Written, Device, Kind, Mac, Object, ObjectId, ObjectType};

use super::units;
use drivegate_core::order::Commanded;
use drivegate_core::process_image::{Access, BusSpec, DriveSpec};
use drivegate_model::drive::model::Kind as Values;
use drivegate_model::drive::profile::Form;
use drivegate_model::drive::{ModelPoint, Point, PointIndex, PollClass, Source, State};

/// Points shown as analog inputs from 1 on.
const ANALOG: [ModelPoint; 12] = [
    ModelPoint::ActualSpeed,
    ModelPoint::OutputFrequency,
    ModelPoint::MotorSpeed,
    ModelPoint::MotorCurrent,
    ModelPoint::MotorTorque,
    ModelPoint::MotorPower,
    ModelPoint::MotorVoltage,
    ModelPoint::DcLinkVoltage,
    ModelPoint::HeatsinkTemperature,
    ModelPoint::Energy,
    ModelPoint::OperatingHours,
    ModelPoint::FaultCode,
];
/// Counters, of which every change is reported.
const COUNTERS: [ModelPoint; 3] = [ModelPoint::Energy, ModelPoint::OperatingHours, ModelPoint::FaultCode];
/// The first number of the points that only the profile has.
const OWN: u32 = 100;
/// The last state of an enumeration: a code without a text.
const OTHER: &str = "other";

/// The meaning of an object.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Meaning {
    /// The object is a point of the profile.
    Point(PointIndex),
    /// A point of the profile that is an enumeration.
    Enumeration(PointIndex),
    /// The object is the state of the drive.
    State,
    /// The object is the text of the active fault.
    FaultText,
    /// A command with a priority array, and its point.
    Slot(Commanded, PointIndex),
    /// A pulse that resets, and its point.
    Reset(PointIndex),
    BusUp(usize),
    BusLoad(usize),
}

/// A device and, in the order of its objects, the meaning of each object.
#[derive(Debug, Clone)]
pub struct ListedDevice {
    /// The device as shown to BACnet clients.
    pub device: Arc<Device>,
    /// The meaning of each object.
    pub meanings: Vec<Meaning>,
}

/// BACnet objects with their meanings.
#[derive(Default)]
struct Objects(Vec<(Object, Meaning)>);

impl Objects {
    fn add(&mut self, id: (ObjectType, u32), texts: (&str, &str), kind: Kind, access: Written, meaning: Meaning) {
        let object = Object {
            id: ObjectId::new(id.0, id.1),
            name: texts.0.into(),
            description: texts.1.into(),
            kind,
            access,
        };
        self.0.push((object, meaning));
    }
}

/// The device of a drive, whose instance is that of the gateway and its unit.
pub fn of_drive(spec: &DriveSpec, gateway: (&str, u32)) -> ListedDevice {
    let mut all = Objects::default();
    model(spec, &mut all);
    if spec.access == Access::Control {
        commands(spec, &mut all);
    }
    own(spec, &mut all);
    let (objects, meanings) = all.0.into_iter().unzip();
    let (name, instance) = gateway;
    let device = Device::new(
        instance + u32::from(spec.unit),
        Mac::new(&[spec.unit]),
        format!("{name}.{}", spec.name),
        (spec.profile.name.clone(), spec.profile.described().into_owned()),
        objects,
    );
    ListedDevice {
        device: Arc::new(device),
        meanings,
    }
}

/// The device of the gateway.
pub fn of_gateway<'b>((name, instance): (&str, u32), buses: impl Iterator<Item = &'b BusSpec>) -> ListedDevice {
    let mut all = Objects::default();
    for (place, (number, bus)) in (1..).zip(buses).enumerate() {
        let (up, load) = (format!("{}.up", bus.name), format!("{}.load", bus.name));
        let texts = (up.as_str(), "the port of the bus is open");
        all.add(
            (ObjectType::BINARY_INPUT, number),
            texts,
            binary(None),
            Written::Read,
            Meaning::BusUp(place),
        );
        let kind = Kind::Analog {
            units: units::number("%"),
            resolution: 0.1,
            range: Some((0.0, 100.0)),
            increment: 1.0,
        };
        let texts = (load.as_str(), "share of the last second in which the line was in use");
        all.add(
            (ObjectType::ANALOG_INPUT, number),
            texts,
            kind,
            Written::Read,
            Meaning::BusLoad(place),
        );
    }
    let (objects, meanings) = all.0.into_iter().unzip();
    let about = ("drivegate".to_string(), "gateway to drives".to_string());
    ListedDevice {
        device: Arc::new(Device::new(instance, None, name.to_string(), about, objects)),
        meanings,
    }
}

/// Numbers of objects of one drive, where all belong to the gateway's device.
const PER_DRIVE: u32 = 1000;

/// The objects of one device that represents all drives, with the unit of the drive of each object; `None` for
/// objects of the gateway.
#[derive(Debug, Clone)]
pub struct Flat {
    /// The device as shown to BACnet clients.
    pub device: Arc<Device>,
    /// The unit and the meaning of each object.
    pub places: Vec<(Option<u8>, Meaning)>,
}

/// All objects of these devices as objects of one device, those of the gateway first: numbers are unit * 1000 + n,
/// names `drive.point`.
pub fn flat(
    (name, instance): (&str, u32),
    gateway: ListedDevice,
    drives: impl Iterator<Item = (String, u8, ListedDevice)>,
) -> Flat {
    let mut objects = gateway.device.objects().to_vec();
    let mut places: Vec<(Option<u8>, Meaning)> = gateway.meanings.iter().map(|meaning| (None, *meaning)).collect();
    for (drive, unit, shown) in drives {
        for (object, meaning) in shown.device.objects().iter().zip(&shown.meanings) {
            // Instances from this number on belong to the next unit.
            if object.id.instance >= PER_DRIVE {
                continue;
            }
            objects.push(Object {
                id: ObjectId::new(object.id.kind, u32::from(unit) * PER_DRIVE + object.id.instance),
                name: format!("{drive}.{}", object.name).into(),
                ..object.clone()
            });
            places.push((Some(unit), *meaning));
        }
    }
    let about = (gateway.device.model.clone(), gateway.device.description.clone());
    Flat {
        device: Arc::new(Device::new(instance, None, name.to_string(), about, objects)),
        places,
    }
}

/// The unit id of the drive to which an object of the single device belongs, and the number of the object in that drive.
pub fn of_flat(object: ObjectId) -> Option<(u8, u32)> {
    let unit = u8::try_from(object.instance / PER_DRIVE)
        .ok()
        .filter(|unit| *unit > 0)?;
    Some((unit, object.instance % PER_DRIVE))
}

/// The points of the common model.
fn model(spec: &DriveSpec, all: &mut Objects) {
    let index = |point: ModelPoint| spec.profile.model_index(point);
    for (number, point) in (1..).zip(ANALOG) {
        if let Some(index) = index(point) {
            let kind = analog(spec, index, Some(point), None);
            let texts = (point.name(), describe(spec, index));
            all.add(
                (ObjectType::ANALOG_INPUT, number),
                (texts.0, &texts.1),
                kind,
                Written::Read,
                Meaning::Point(index),
            );
        }
    }
    // Status bits are binary inputs from 1 on.
    for (number, point) in (1..).zip(ModelPoint::STATUS_WORD) {
        if let Some(index) = index(point) {
            let texts = (point.name(), describe(spec, index));
            let kind = binary(spec.profile.points.get(index));
            all.add(
                (ObjectType::BINARY_INPUT, number),
                (texts.0, &texts.1),
                kind,
                Written::Read,
                Meaning::Point(index),
            );
        }
    }
    let states: Vec<String> = State::ALL.iter().map(|state| state.name().to_string()).collect();
    let kind = Kind::MultiState { texts: states.into() };
    let texts = ("state", "the drive in one word");
    all.add(
        (ObjectType::MULTI_STATE_INPUT, 1),
        texts,
        kind,
        Written::Read,
        Meaning::State,
    );
    if index(ModelPoint::FaultCode).is_some() {
        let texts = ("fault_text", "text of the active fault");
        all.add(
            (ObjectType::CHARACTERSTRING_VALUE, 1),
            texts,
            Kind::Text,
            Written::Read,
            Meaning::FaultText,
        );
    }
}

/// Adds the command objects of a controlled drive.
fn commands(spec: &DriveSpec, all: &mut Objects) {
    let bits = [
        (1, ModelPoint::Run, Some(Commanded::Run)),
        (2, ModelPoint::Reverse, Some(Commanded::Reverse)),
        (3, ModelPoint::FaultReset, None),
    ];
    for (number, point, slot) in bits {
        let Some(index) = spec.profile.model_index(point) else {
            continue;
        };
        let meaning = slot.map_or(Meaning::Reset(index), |slot| Meaning::Slot(slot, index));
        let texts = (point.name(), describe(spec, index));
        let kind = binary(None);
        all.add(
            (ObjectType::BINARY_VALUE, number),
            (texts.0, &texts.1),
            kind,
            Written::Command,
            meaning,
        );
    }
    let references = [
        (1, ModelPoint::SpeedReference, Commanded::SpeedReference),
        (2, ModelPoint::FrequencyReference, Commanded::FrequencyReference),
    ];
    for (number, point, slot) in references {
        let Some(index) = spec.profile.model_index(point) else {
            continue;
        };
        let kind = analog(spec, index, Some(point), spec.limits_of(index));
        let texts = (point.name(), describe(spec, index));
        let meaning = Meaning::Slot(slot, index);
        all.add(
            (ObjectType::ANALOG_VALUE, number),
            (texts.0, &texts.1),
            kind,
            Written::Command,
            meaning,
        );
    }
}

/// Adds the points that only the profile has, in its order, numbered across all types.
fn own(spec: &DriveSpec, all: &mut Objects) {
    let profile = &spec.profile;
    let own = profile.points.enumerate().filter(|(_, point)| point.model.is_none());
    for (number, (index, point)) in (OWN..).zip(own) {
        let writable = point.write && spec.access == Access::Control;
        let unread = point.raw().is_some() && point.class == PollClass::Never;
        // A point that is left out still uses up its number.
        if point.hidden || (unread && !writable) {
            continue;
        }
        let access = if writable { Written::Write } else { Written::Read };
        let of_type = |input: ObjectType, value: ObjectType| if writable { value } else { input };
        let texts = (point.name.as_str(), describe(spec, index));
        let texts = (texts.0, texts.1.as_str());
        match point.kind() {
            Values::Bool => {
                let kind = of_type(ObjectType::BINARY_INPUT, ObjectType::BINARY_VALUE);
                all.add(
                    (kind, number),
                    texts,
                    binary(Some(point)),
                    access,
                    Meaning::Point(index),
                );
            }
            Values::Integer if !point.texts.is_empty() && !writable => {
                let states = point.texts.values().cloned().chain([OTHER.to_string()]);
                let kind = Kind::MultiState {
                    texts: states.collect::<Vec<_>>().into(),
                };
                let id = (ObjectType::MULTI_STATE_INPUT, number);
                all.add(id, texts, kind, Written::Read, Meaning::Enumeration(index));
            }
            Values::Text => {
                let id = (ObjectType::CHARACTERSTRING_VALUE, number);
                all.add(id, texts, Kind::Text, Written::Read, Meaning::Point(index));
            }
            Values::Integer | Values::Number => {
                let kind = of_type(ObjectType::ANALOG_INPUT, ObjectType::ANALOG_VALUE);
                let limits = spec.limits_of(index).filter(|_| writable);
                let analog = analog(spec, index, None, limits);
                all.add((kind, number), texts, analog, access, Meaning::Point(index));
            }
        }
    }
}

/// The state of an enumeration, counted from 1: the position of its code among the codes with texts.
pub(super) fn state_of(point: &Point, code: i64) -> u32 {
    let place = point
        .texts
        .keys()
        .position(|known| *known == code)
        .unwrap_or(point.texts.len());
    u32::try_from(place + 1).unwrap_or(u32::MAX)
}

fn describe(spec: &DriveSpec, index: PointIndex) -> String {
    let Some(point) = spec.profile.points.get(index) else {
        return String::new();
    };
    let words = point.name.replace('_', " ");
    let unverified = if point.verified {
        ""
    } else {
        "; not confirmed by a manual"
    };
    if point.note.is_empty() {
        format!("{words}{unverified}")
    } else {
        format!("{words}: {}{unverified}", point.note)
    }
}

fn binary(point: Option<&Point>) -> Kind {
    let text = |code: i64, otherwise: &str| -> Arc<str> {
        let text = point.and_then(|point| point.texts.get(&code));
        Arc::from(text.map_or(otherwise, String::as_str))
    };
    Kind::Binary {
        texts: [text(0, "inactive"), text(1, "active")],
    }
}

fn analog(spec: &DriveSpec, index: PointIndex, model: Option<ModelPoint>, limits: Option<RangeInclusive<f64>>) -> Kind {
    let point = spec.profile.points.get(index);
    let unit = point.map_or("", |point| point.unit.as_str());
    let raw = raw_of(spec, index, 4);
    let resolution = match raw.map(|(form, scale)| (form, scale.abs())) {
        Some((Form::F32, _)) | None => 0.01,
        Some((_, scale)) => scale,
    };
    let span = raw.and_then(|(form, scale)| {
        let (low, high) = match form {
            Form::U16 => (0.0, f64::from(u16::MAX)),
            Form::I16 => (f64::from(i16::MIN), f64::from(i16::MAX)),
            _ => return None,
        };
        Some((low * scale, high * scale))
    });
    let is_raw = point.is_some_and(|point| matches!(point.source, Source::Raw(_)));
    let range = limits
        .map(|limits| (*limits.start(), *limits.end()))
        .or(span.filter(|_| is_raw));
    let counts = model.is_some_and(|model| COUNTERS.contains(&model));
    Kind::Analog {
        units: units::number(unit),
        resolution: resolution as f32,
        range: range.map(|(low, high)| (low as f32, high as f32)),
        increment: if counts { 1.0 } else { (10.0 * resolution) as f32 },
    }
}

/// Form and scale of the register from which the point is read.
fn raw_of(spec: &DriveSpec, index: PointIndex, depth: usize) -> Option<(Form, f64)> {
    let point = spec.profile.points.get(index)?;
    match &point.source {
        Source::Raw(raw) => Some((raw.form, raw.scale)),
        Source::Derived(derived) if depth > 0 => {
            let first = derived.sources().next()?;
            raw_of(spec, first, depth - 1)
        }
        Source::Derived(_) => None,
    }
}
