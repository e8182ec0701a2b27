//! The objects of a device. The description of an object is fixed; its value is requested from the application.

mod properties;

use std::collections::HashMap;
use std::sync::Arc;

use crate::types::{Address, DateTime, Mac, ObjectId, ObjectType};

pub(crate) use properties::{Context, Environment, Port, cov_value, list, property};

/// A BACnet device with its objects.
#[derive(Debug, PartialEq)]
pub struct Device {
    /// Instance number of the device, 0..=4194302, unique in the network.
    pub instance: u32,
    /// Station of the device on the virtual network; `None` for the device of the host itself.
    pub station: Option<Mac>,
    /// Name of the device, unique in the network.
    pub name: String,
    /// Text for the Description property of the device.
    pub description: String,
    /// Text for the Model_Name property of the device.
    pub model: String,
    objects: Vec<Object>,
    by_id: HashMap<ObjectId, usize>,
    revision: u32,
}

/// An object of a BACnet device.
#[derive(Debug, Clone, PartialEq)]
pub struct Object {
    /// Identifier of the object, unique in the device.
    pub id: ObjectId,
    /// Name of the object, unique in the device.
    pub name: Arc<str>,
    /// Text for the Description property of the object.
    pub description: Arc<str>,
    /// The kind of the object's values.
    pub kind: Kind,
    /// How the object can be written.
    pub access: Access,
}

/// How an object is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    /// Clients may read the object but not write it.
    Read,
    /// Clients may write Present_Value; the object has no priority array.
    Write,
    /// Writes have one of sixteen priorities.
    Command,
}

/// The kind of an object's values.
#[derive(Debug, Clone, PartialEq)]
pub enum Kind {
    /// The values are numbers.
    Analog {
        /// The unit by the number of the standard.
        units: u32,
        /// The smallest difference between two values.
        resolution: f32,
        /// Smallest and greatest value, if known.
        range: Option<(f32, f32)>,
        /// The change that is worth a notification, unless a client sets another.
        increment: f32,
    },
    /// The values are inactive and active.
    Binary {
        /// Texts of the two states.
        texts: [Arc<str>; 2],
    },
    /// A value that is one of several states, numbered from 1.
    MultiState {
        /// Texts of the states.
        texts: Arc<[String]>,
    },
    /// The values are texts.
    Text,
}

/// The value of an object.
#[derive(Debug, Clone, PartialEq)]
pub enum Datum {
    /// Value of an analog object.
    Number(f64),
    /// Value of a binary object: true is active.
    Bool(bool),
    /// Value of a multi-state object: the state, from 1.
    State(u32),
    /// Value of a character string object.
    Text(Arc<str>),
}

/// Whether a value can be relied on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reliability {
    /// The value is reliable.
    NoFault = 0,
    /// The source gives no valid value.
    UnreliableOther = 7,
    /// The source does not answer, or not in time.
    CommunicationFailure = 12,
}

/// A value with its time and quality.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample {
    /// The last value; `None` if no value was ever read.
    pub value: Option<Datum>,
    /// Whether the value can be relied on, and if not, why.
    pub reliability: Reliability,
    /// When the value was read.
    pub at: Option<DateTime>,
}

/// The source that wrote a value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ValueSource {
    /// The writer is not known.
    #[default]
    None,
    /// A client with this address wrote the value.
    Address(Address),
    /// A device given by its instance.
    Device(u32),
}

/// A slot of a priority array.
#[derive(Debug, Clone, PartialEq)]
pub struct Slot {
    /// The commanded value at this priority.
    pub value: Datum,
    /// The client that wrote the value.
    pub source: ValueSource,
    /// When the slot was written.
    pub at: DateTime,
}

/// The priority array of an object.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Commands {
    /// The value of each slot, priority 1 first.
    pub slots: [Option<Slot>; 16],
    /// The priority in effect.
    pub current: Option<u8>,
    /// The value when all slots are empty.
    pub default: Option<Datum>,
    /// The source of the present value.
    pub source: ValueSource,
    /// When the present command was written.
    pub at: Option<DateTime>,
}

impl Device {
    /// A device with these objects. If several objects have one identifier, only the first one is used.
    pub fn new(
        instance: u32,
        station: Option<Mac>,
        name: String,
        (model, description): (String, String),
        objects: Vec<Object>,
    ) -> Device {
        let mut by_id = HashMap::with_capacity(objects.len());
        for (place, object) in objects.iter().enumerate() {
            by_id.entry(object.id).or_insert(place);
        }
        let revision = revision(&name, &objects);
        Device {
            instance,
            station,
            name,
            description,
            model,
            objects,
            by_id,
            revision,
        }
    }

    /// The identifier of the Device object.
    pub fn id(&self) -> ObjectId {
        ObjectId::new(ObjectType::DEVICE, self.instance)
    }

    /// The objects of the device, without the Device object and the Network Port.
    pub fn objects(&self) -> &[Object] {
        &self.objects
    }

    /// The index of an object in its device.
    pub fn find(&self, id: ObjectId) -> Option<usize> {
        self.by_id.get(&id).copied()
    }

    /// The identifiers of all objects, including the device and its port.
    pub fn object_list(&self) -> impl Iterator<Item = ObjectId> + '_ {
        let own = [self.id(), ObjectId::new(ObjectType::NETWORK_PORT, 1)];
        own.into_iter().chain(self.objects.iter().map(|object| object.id))
    }

    /// The object with this name.
    pub(crate) fn named(&self, name: &str) -> Option<ObjectId> {
        if name == self.name {
            return Some(self.id());
        }
        if name == PORT_NAME {
            return Some(ObjectId::new(ObjectType::NETWORK_PORT, 1));
        }
        self.objects
            .iter()
            .find(|object| &*object.name == name)
            .map(|object| object.id)
    }

    /// A number that changes when the list of objects changes.
    pub(crate) fn revision(&self) -> u32 {
        self.revision
    }
}

/// Name of the Network Port object.
pub(crate) const PORT_NAME: &str = "network_port";

/// FNV-1a over what identifies the objects.
fn revision(name: &str, objects: &[Object]) -> u32 {
    let mut hash = 0x811C_9DC5_u32;
    let mut add = |bytes: &[u8]| {
        for byte in bytes {
            hash = (hash ^ u32::from(*byte)).wrapping_mul(0x0100_0193);
        }
    };
    add(name.as_bytes());
    for object in objects {
        add(&object.id.bits().to_be_bytes());
        add(object.name.as_bytes());
    }
    hash
}

impl Kind {
    /// Whether a value is of this kind.
    pub(crate) fn accepts(&self, datum: &Datum) -> bool {
        matches!(
            (self, datum),
            (Kind::Analog { .. }, Datum::Number(_))
                | (Kind::Binary { .. }, Datum::Bool(_))
                | (Kind::MultiState { .. }, Datum::State(_))
                | (Kind::Text, Datum::Text(_))
        )
    }
}
