//! The properties of objects as they are encoded on the wire (clause 12).

use std::net::SocketAddrV4;
use std::sync::Arc;

use super::{Access, Commands, Datum, Device, Kind, Object, PORT_NAME, Reliability, Sample, Slot, ValueSource};
use crate::apdu::MAX_APDU;
use crate::encoding::Writer;
use crate::services::{PropertyRef, SUPPORTED};
use crate::types::{Address, DateTime, Error, ObjectId, ObjectType, PropertyId as P};

/// The settings common to all devices of a server.
#[derive(Debug, Clone)]
pub(crate) struct Environment {
    pub(crate) vendor: u16,
    pub(crate) vendor_name: Arc<str>,
    pub(crate) version: Arc<str>,
    /// The Network Port object of the host.
    pub(crate) port: Port,
    /// Number of the virtual network.
    pub(crate) network: u16,
}

/// Data of the host's Network Port object.
#[derive(Debug, Clone)]
pub(crate) struct Port {
    pub(crate) address: SocketAddrV4,
    pub(crate) prefix: u8,
    /// The BBMD at which the port registers, and for how many seconds.
    pub(crate) bbmd: Option<(SocketAddrV4, u16)>,
}

/// An object whose properties are read, with its present value.
pub(crate) enum Context<'a> {
    Device {
        device: &'a Device,
        now: DateTime,
        subscriptions: &'a dyn Fn(&mut Writer),
    },
    Port(&'a Device),
    Object {
        object: &'a Object,
        sample: Sample,
        commands: Option<Box<Commands>>,
        increment: f32,
    },
}

impl Context<'_> {
    fn id(&self) -> ObjectId {
        match self {
            Context::Device { device, .. } => device.id(),
            Context::Port(_) => ObjectId::new(ObjectType::NETWORK_PORT, 1),
            Context::Object { object, .. } => object.id,
        }
    }
}

const DEVICE: [P; 29] = [
    P::OBJECT_IDENTIFIER,
    P::OBJECT_NAME,
    P::OBJECT_TYPE,
    P::SYSTEM_STATUS,
    P::VENDOR_NAME,
    P::VENDOR_IDENTIFIER,
    P::MODEL_NAME,
    P::FIRMWARE_REVISION,
    P::APPLICATION_SOFTWARE_VERSION,
    P::PROTOCOL_VERSION,
    P::PROTOCOL_REVISION,
    P::PROTOCOL_SERVICES_SUPPORTED,
    P::PROTOCOL_OBJECT_TYPES_SUPPORTED,
    P::OBJECT_LIST,
    P::MAX_APDU_LENGTH_ACCEPTED,
    P::SEGMENTATION_SUPPORTED,
    P::APDU_TIMEOUT,
    P::NUMBER_OF_APDU_RETRIES,
    P::DEVICE_ADDRESS_BINDING,
    P::DATABASE_REVISION,
    P::PROPERTY_LIST,
    P::DESCRIPTION,
    P::MAX_SEGMENTS_ACCEPTED,
    P::APDU_SEGMENT_TIMEOUT,
    P::LOCAL_DATE,
    P::LOCAL_TIME,
    P::UTC_OFFSET,
    P::DAYLIGHT_SAVINGS_STATUS,
    P::ACTIVE_COV_SUBSCRIPTIONS,
];
/// Number of the properties above that the standard requires.
const DEVICE_REQUIRED: usize = 21;

const PORT: [P; 10] = [
    P::OBJECT_IDENTIFIER,
    P::OBJECT_NAME,
    P::OBJECT_TYPE,
    P::STATUS_FLAGS,
    P::RELIABILITY,
    P::OUT_OF_SERVICE,
    P::NETWORK_TYPE,
    P::PROTOCOL_LEVEL,
    P::CHANGES_PENDING,
    P::PROPERTY_LIST,
];
const PORT_SHARED: [P; 4] = [
    P::NETWORK_NUMBER,
    P::NETWORK_NUMBER_QUALITY,
    P::APDU_LENGTH,
    P::MAC_ADDRESS,
];
const PORT_IP: [P; 6] = [
    P::LINK_SPEED,
    P::BACNET_IP_MODE,
    P::IP_ADDRESS,
    P::BACNET_IP_UDP_PORT,
    P::IP_SUBNET_MASK,
    P::IP_DEFAULT_GATEWAY,
];
const PORT_FOREIGN: [P; 2] = [P::FD_BBMD_ADDRESS, P::FD_SUBSCRIPTION_LIFETIME];

const SHARED: [P; 7] = [
    P::OBJECT_IDENTIFIER,
    P::OBJECT_NAME,
    P::OBJECT_TYPE,
    P::PRESENT_VALUE,
    P::STATUS_FLAGS,
    P::OUT_OF_SERVICE,
    P::EVENT_STATE,
];
const COMMANDABLE: [P; 3] = [P::PRIORITY_ARRAY, P::RELINQUISH_DEFAULT, P::CURRENT_COMMAND_PRIORITY];
const SOURCES: [P; 4] = [
    P::VALUE_SOURCE,
    P::VALUE_SOURCE_ARRAY,
    P::LAST_COMMAND_TIME,
    P::COMMAND_TIME_ARRAY,
];

/// The properties that an object has: those that the standard requires, and the optional ones.
pub(crate) fn list(of: &Context<'_>, environment: &Environment) -> (Vec<P>, Vec<P>) {
    match of {
        Context::Device { .. } => {
            let (required, optional) = DEVICE.split_at(DEVICE_REQUIRED);
            (required.to_vec(), optional.to_vec())
        }
        Context::Port(device) => {
            let mut more = PORT_SHARED.to_vec();
            more.push(P::DESCRIPTION);
            if device.station.is_none() {
                more.extend(PORT_IP);
                if environment.port.bbmd.is_some() {
                    more.extend(PORT_FOREIGN);
                }
            }
            (PORT.to_vec(), more)
        }
        Context::Object { object, .. } => of_object(object),
    }
}

fn of_object(object: &Object) -> (Vec<P>, Vec<P>) {
    let mut required = SHARED.to_vec();
    let mut optional = vec![P::DESCRIPTION, P::RELIABILITY];
    match &object.kind {
        Kind::Analog { range, .. } => {
            required.push(P::UNITS);
            optional.extend([P::RESOLUTION, P::COV_INCREMENT]);
            if range.is_some() {
                optional.extend([P::MIN_PRES_VALUE, P::MAX_PRES_VALUE]);
            }
        }
        Kind::Binary { .. } => {
            if object.id.kind == ObjectType::BINARY_INPUT {
                required.push(P::POLARITY);
            }
            optional.extend([P::INACTIVE_TEXT, P::ACTIVE_TEXT]);
        }
        Kind::MultiState { .. } => {
            required.push(P::NUMBER_OF_STATES);
            optional.push(P::STATE_TEXT);
        }
        Kind::Text => {}
    }
    if object.access == Access::Command {
        required.extend(COMMANDABLE);
        optional.extend(SOURCES);
    }
    required.push(P::PROPERTY_LIST);
    optional.push(P::VALUE_TIME);
    (required, optional)
}

/// Encodes an array, or one element of it.
fn array(
    out: &mut Writer,
    index: Option<u32>,
    len: usize,
    mut element: impl FnMut(&mut Writer, usize),
) -> Result<(), Error> {
    match index {
        None => (0..len).for_each(|place| element(out, place)),
        Some(0) => drop(out.unsigned(len as u64)),
        Some(index) => {
            let place = usize::try_from(index - 1).ok().filter(|place| *place < len);
            element(out, place.ok_or(Error::INVALID_ARRAY_INDEX)?);
        }
    }
    Ok(())
}

/// Writes the value of a property.
///
/// # Errors
/// If the object has no such property, or the property no such element.
pub(crate) fn property(
    out: &mut Writer,
    of: &Context<'_>,
    asked: PropertyRef,
    environment: &Environment,
) -> Result<(), Error> {
    if let Some(done) = arrays(out, of, asked, environment) {
        return done;
    }
    let mut value = Writer::default();
    let known = match of {
        Context::Device {
            device,
            now,
            subscriptions,
        } => of_device(&mut value, device, (*now, subscriptions), asked.property, environment),
        Context::Port(device) => of_port(&mut value, device, asked.property, environment),
        Context::Object {
            object,
            sample,
            commands,
            increment,
        } => value_of(
            &mut value,
            (object, sample, *increment),
            commands.as_deref(),
            asked.property,
        ),
    };
    if !known {
        Err(Error::UNKNOWN_PROPERTY)
    } else if asked.index.is_some() {
        Err(Error::NOT_AN_ARRAY)
    } else {
        out.raw(value.bytes());
        Ok(())
    }
}

/// Writes properties that are arrays.
fn arrays(
    out: &mut Writer,
    of: &Context<'_>,
    asked: PropertyRef,
    environment: &Environment,
) -> Option<Result<(), Error>> {
    let index = asked.index;
    Some(match (asked.property, of) {
        (P::PROPERTY_LIST, _) => {
            // Property_List leaves out the four properties that every object has.
            let left_out = [P::OBJECT_NAME, P::OBJECT_TYPE, P::OBJECT_IDENTIFIER, P::PROPERTY_LIST];
            let (required, optional) = list(of, environment);
            let all = required.into_iter().chain(optional);
            let all: Vec<P> = all.filter(|property| !left_out.contains(property)).collect();
            array(out, index, all.len(), |out, place| {
                if let Some(property) = all.get(place) {
                    out.enumerated(property.0);
                }
            })
        }
        (P::OBJECT_LIST, Context::Device { device, .. }) => {
            array(out, index, device.objects.len() + 2, |out, place| {
                if let Some(id) = device.object_list().nth(place) {
                    out.object(id);
                }
            })
        }
        (P::STATE_TEXT, Context::Object { object, .. }) => match &object.kind {
            Kind::MultiState { texts } => array(out, index, texts.len(), |out, place| {
                out.text(texts.get(place).map_or("", String::as_str));
            }),
            _ => return None,
        },
        (
            _,
            Context::Object {
                object,
                commands: Some(commands),
                ..
            },
        ) if object.access == Access::Command => {
            let slot = |place: usize| commands.slots.get(place).and_then(Option::as_ref);
            match asked.property {
                P::PRIORITY_ARRAY => array(out, index, 16, |out, place| match slot(place) {
                    Some(slot) => datum(out, object.id.kind, &slot.value),
                    None => drop(out.null()),
                }),
                P::VALUE_SOURCE_ARRAY => array(out, index, 16, |out, place| {
                    source(out, slot(place).map_or(ValueSource::None, |slot| slot.source));
                }),
                P::COMMAND_TIME_ARRAY => array(out, index, 16, |out, place| {
                    time_stamp(out, slot(place).map(|slot: &Slot| slot.at));
                }),
                _ => return None,
            }
        }
        _ => return None,
    })
}

fn of_device(
    out: &mut Writer,
    device: &Device,
    (now, subscriptions): (DateTime, &dyn Fn(&mut Writer)),
    property: P,
    environment: &Environment,
) -> bool {
    match property {
        P::OBJECT_IDENTIFIER => out.object(device.id()),
        P::OBJECT_NAME => out.text(&device.name),
        P::OBJECT_TYPE => out.enumerated(ObjectType::DEVICE.0.into()),
        P::SYSTEM_STATUS => out.enumerated(0),
        P::VENDOR_NAME => out.text(&environment.vendor_name),
        P::VENDOR_IDENTIFIER => out.unsigned(environment.vendor.into()),
        P::MODEL_NAME => out.text(&device.model),
        P::DESCRIPTION => out.text(&device.description),
        P::FIRMWARE_REVISION | P::APPLICATION_SOFTWARE_VERSION => out.text(&environment.version),
        P::PROTOCOL_VERSION => out.unsigned(1),
        P::PROTOCOL_REVISION => out.unsigned(22),
        P::PROTOCOL_SERVICES_SUPPORTED => out.bits(&bits(47, SUPPORTED.into_iter())),
        P::PROTOCOL_OBJECT_TYPES_SUPPORTED => {
            let types = ObjectType::SUPPORTED.iter().map(|kind| usize::from(kind.0));
            out.bits(&bits(63, types))
        }
        P::MAX_APDU_LENGTH_ACCEPTED => out.unsigned(MAX_APDU as u64),
        // The value means: segmented transmit.
        P::SEGMENTATION_SUPPORTED => out.enumerated(1),
        P::MAX_SEGMENTS_ACCEPTED => out.unsigned(1),
        P::APDU_SEGMENT_TIMEOUT | P::APDU_TIMEOUT => out.unsigned(3000),
        P::NUMBER_OF_APDU_RETRIES => out.unsigned(2),
        P::DEVICE_ADDRESS_BINDING => out,
        P::DATABASE_REVISION => out.unsigned(device.revision().into()),
        P::LOCAL_DATE => out.date(now.date),
        P::LOCAL_TIME => out.time(now.time),
        P::UTC_OFFSET => out.signed(0),
        P::DAYLIGHT_SAVINGS_STATUS => out.bool(false),
        P::ACTIVE_COV_SUBSCRIPTIONS => {
            subscriptions(out);
            out
        }
        _ => return false,
    };
    true
}

fn bits(len: usize, set: impl Iterator<Item = usize>) -> Vec<bool> {
    let mut bits = vec![false; len];
    for place in set {
        if let Some(bit) = bits.get_mut(place) {
            *bit = true;
        }
    }
    bits
}

fn of_port(out: &mut Writer, device: &Device, property: P, environment: &Environment) -> bool {
    let port = &environment.port;
    let is_ip = device.station.is_none();
    match property {
        P::OBJECT_IDENTIFIER => out.object(ObjectId::new(ObjectType::NETWORK_PORT, 1)),
        P::OBJECT_NAME => out.text(PORT_NAME),
        P::OBJECT_TYPE => out.enumerated(ObjectType::NETWORK_PORT.0.into()),
        P::DESCRIPTION if is_ip => out.text("BACnet/IP"),
        P::DESCRIPTION => out.text("the virtual network of the drives"),
        P::STATUS_FLAGS => out.bits(&[false; 4]),
        P::RELIABILITY => out.enumerated(0),
        P::OUT_OF_SERVICE | P::CHANGES_PENDING => out.bool(false),
        P::NETWORK_TYPE => out.enumerated(if is_ip { 5 } else { 7 }),
        // The value means: BACnet application.
        P::PROTOCOL_LEVEL => out.enumerated(2),
        // The number of the network of the port is not known here; that of the drives is configured.
        P::NETWORK_NUMBER => out.unsigned(if is_ip { 0 } else { environment.network.into() }),
        P::NETWORK_NUMBER_QUALITY => out.enumerated(if is_ip { 0 } else { 3 }),
        P::APDU_LENGTH => out.unsigned(MAX_APDU as u64),
        P::MAC_ADDRESS => match &device.station {
            None => out.octets(&Address::host_octets(port.address)),
            Some(mac) => out.octets(mac.octets()),
        },
        P::LINK_SPEED if is_ip => out.real(0.0),
        P::BACNET_IP_MODE if is_ip => out.enumerated(u32::from(port.bbmd.is_some())),
        P::IP_ADDRESS if is_ip => out.octets(&port.address.ip().octets()),
        P::BACNET_IP_UDP_PORT if is_ip => out.unsigned(port.address.port().into()),
        P::IP_SUBNET_MASK if is_ip => {
            let mask = u32::MAX.checked_shl(32 - u32::from(port.prefix.min(32))).unwrap_or(0);
            out.octets(&mask.to_be_bytes())
        }
        P::IP_DEFAULT_GATEWAY if is_ip => out.octets(&[0; 4]),
        P::FD_BBMD_ADDRESS | P::FD_SUBSCRIPTION_LIFETIME if is_ip => {
            let Some((bbmd, seconds)) = port.bbmd else { return false };
            match property {
                P::FD_SUBSCRIPTION_LIFETIME => out.unsigned(seconds.into()),
                _ => {
                    out.open(0).context_octets(1, &bbmd.ip().octets()).close(0);
                    out.context_unsigned(1, bbmd.port().into())
                }
            }
        }
        _ => return false,
    };
    true
}

/// Writes a value in the form that an object of this type has.
fn datum(out: &mut Writer, kind: ObjectType, value: &Datum) {
    match value {
        Datum::Number(number) => out.real(*number as f32),
        Datum::Bool(on) => out.enumerated(u32::from(*on)),
        Datum::State(state) => out.unsigned((*state).into()),
        Datum::Text(text) => out.text(text),
    };
    debug_assert!(kind != ObjectType::DEVICE);
}

/// The value of an object of that kind before the first read.
fn nothing(kind: &Kind) -> Datum {
    match kind {
        Kind::Analog { .. } => Datum::Number(0.0),
        Kind::Binary { .. } => Datum::Bool(false),
        Kind::MultiState { .. } => Datum::State(1),
        Kind::Text => Datum::Text(Arc::from("")),
    }
}

fn shown(object: &Object, value: Option<&Datum>) -> Datum {
    match value.filter(|value| object.kind.accepts(value)) {
        Some(value) => value.clone(),
        None => nothing(&object.kind),
    }
}

fn flags(sample: &Sample) -> [bool; 4] {
    [false, sample.reliability != Reliability::NoFault, false, false]
}

fn value_of(
    out: &mut Writer,
    (object, sample, increment): (&Object, &Sample, f32),
    commands: Option<&Commands>,
    property: P,
) -> bool {
    let kind = object.id.kind;
    match property {
        P::OBJECT_IDENTIFIER => drop(out.object(object.id)),
        P::OBJECT_NAME => drop(out.text(&object.name)),
        P::OBJECT_TYPE => drop(out.enumerated(kind.0.into())),
        P::DESCRIPTION => drop(out.text(&object.description)),
        P::PRESENT_VALUE => datum(out, kind, &shown(object, sample.value.as_ref())),
        P::STATUS_FLAGS => drop(out.bits(&flags(sample))),
        P::EVENT_STATE => drop(out.enumerated(u32::from(sample.reliability != Reliability::NoFault))),
        P::RELIABILITY => drop(out.enumerated(sample.reliability as u32)),
        P::OUT_OF_SERVICE => drop(out.bool(false)),
        P::VALUE_TIME => drop(out.date_time(sample.at.unwrap_or(DateTime::UNSPECIFIED))),
        _ => return of_kind(out, object, increment, property) || of_commands(out, object, commands, property),
    }
    true
}

fn of_kind(out: &mut Writer, object: &Object, own_increment: f32, property: P) -> bool {
    match (&object.kind, property) {
        (Kind::Analog { units, .. }, P::UNITS) => out.enumerated(*units),
        (Kind::Analog { resolution, .. }, P::RESOLUTION) => out.real(*resolution),
        (
            Kind::Analog {
                range: Some((low, _)), ..
            },
            P::MIN_PRES_VALUE,
        ) => out.real(*low),
        (
            Kind::Analog {
                range: Some((_, high)), ..
            },
            P::MAX_PRES_VALUE,
        ) => out.real(*high),
        (Kind::Analog { .. }, P::COV_INCREMENT) => out.real(own_increment),
        (Kind::Binary { .. }, P::POLARITY) if object.id.kind == ObjectType::BINARY_INPUT => out.enumerated(0),
        (Kind::Binary { texts: [inactive, _] }, P::INACTIVE_TEXT) => out.text(inactive),
        (Kind::Binary { texts: [_, active] }, P::ACTIVE_TEXT) => out.text(active),
        (Kind::MultiState { texts }, P::NUMBER_OF_STATES) => out.unsigned(texts.len() as u64),
        _ => return false,
    };
    true
}

fn of_commands(out: &mut Writer, object: &Object, commands: Option<&Commands>, property: P) -> bool {
    let Some(commands) = commands.filter(|_| object.access == Access::Command) else {
        return false;
    };
    match property {
        P::RELINQUISH_DEFAULT => datum(out, object.id.kind, &shown(object, commands.default.as_ref())),
        P::CURRENT_COMMAND_PRIORITY => match commands.current {
            Some(priority) => drop(out.unsigned(priority.into())),
            None => drop(out.null()),
        },
        P::VALUE_SOURCE => source(out, commands.source),
        P::LAST_COMMAND_TIME => time_stamp(out, commands.at),
        _ => return false,
    }
    true
}

fn source(out: &mut Writer, source: ValueSource) {
    match source {
        ValueSource::None => drop(out.context_null(0)),
        ValueSource::Device(instance) => {
            out.open(1)
                .context_object(1, ObjectId::new(ObjectType::DEVICE, instance))
                .close(1);
        }
        ValueSource::Address(address) => {
            out.open(2);
            match &address.remote {
                None => out.unsigned(0).octets(&Address::host_octets(address.host)),
                Some((network, mac)) => out.unsigned((*network).into()).octets(mac.octets()),
            };
            out.close(2);
        }
    }
}

fn time_stamp(out: &mut Writer, at: Option<DateTime>) {
    out.open(2).date_time(at.unwrap_or(DateTime::UNSPECIFIED)).close(2);
}

/// The properties in a notification of an object: its value and its flags.
pub(crate) fn cov_value(of: &Context<'_>) -> &'static [P] {
    match of {
        Context::Device { .. } => &[P::SYSTEM_STATUS],
        Context::Port(_) => &[P::STATUS_FLAGS],
        Context::Object { .. } => &[P::PRESENT_VALUE, P::STATUS_FLAGS],
    }
}

impl Context<'_> {
    /// The number that is compared with an increment, and the flags.
    pub(crate) fn figure(&self) -> (Option<f64>, [bool; 4]) {
        match self {
            Context::Object { object, sample, .. } => {
                let number = match shown(object, sample.value.as_ref()) {
                    Datum::Number(number) => Some(number),
                    _ => None,
                };
                (number, flags(sample))
            }
            _ => (None, [false; 4]),
        }
    }

    /// The identifier of the object.
    pub(crate) fn object_id(&self) -> ObjectId {
        self.id()
    }
}
