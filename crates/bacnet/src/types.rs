//! Identifiers, errors and values, with the numbers of ASHRAE 135.

use std::fmt;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::str::FromStr;

/// The instance that stands for the addressed device.
pub const WILDCARD: u32 = 4_194_303;

/// Number of a BACnet object type.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ObjectType(pub u16);

impl ObjectType {
    /// Object type Analog Input.
    pub const ANALOG_INPUT: ObjectType = ObjectType(0);
    /// Object type Analog Value.
    pub const ANALOG_VALUE: ObjectType = ObjectType(2);
    /// Object type Binary Input.
    pub const BINARY_INPUT: ObjectType = ObjectType(3);
    /// Object type Binary Value.
    pub const BINARY_VALUE: ObjectType = ObjectType(5);
    /// Object type Device.
    pub const DEVICE: ObjectType = ObjectType(8);
    /// Object type Multi-state Input.
    pub const MULTI_STATE_INPUT: ObjectType = ObjectType(13);
    /// Object type CharacterString Value.
    pub const CHARACTERSTRING_VALUE: ObjectType = ObjectType(40);
    /// Object type Network Port.
    pub const NETWORK_PORT: ObjectType = ObjectType(56);

    /// Types that a server of this crate can show.
    pub const SUPPORTED: [ObjectType; 8] = [
        ObjectType::ANALOG_INPUT,
        ObjectType::ANALOG_VALUE,
        ObjectType::BINARY_INPUT,
        ObjectType::BINARY_VALUE,
        ObjectType::DEVICE,
        ObjectType::MULTI_STATE_INPUT,
        ObjectType::CHARACTERSTRING_VALUE,
        ObjectType::NETWORK_PORT,
    ];

    /// The usual abbreviation of the object type.
    pub fn short(self) -> &'static str {
        match self {
            ObjectType::ANALOG_INPUT => "AI",
            ObjectType::ANALOG_VALUE => "AV",
            ObjectType::BINARY_INPUT => "BI",
            ObjectType::BINARY_VALUE => "BV",
            ObjectType::DEVICE => "DEV",
            ObjectType::MULTI_STATE_INPUT => "MSI",
            ObjectType::CHARACTERSTRING_VALUE => "CSV",
            ObjectType::NETWORK_PORT => "NP",
            _ => "?",
        }
    }
}

/// Identifier of a BACnet object.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ObjectId {
    /// Type of the object.
    pub kind: ObjectType,
    /// Instance number of the object, 0..=4194303.
    pub instance: u32,
}

impl ObjectId {
    /// The object of that type and number.
    pub const fn new(kind: ObjectType, instance: u32) -> ObjectId {
        ObjectId { kind, instance }
    }

    /// The identifier as encoded on the wire.
    pub fn bits(self) -> u32 {
        (u32::from(self.kind.0) << 22) | (self.instance & 0x3F_FFFF)
    }

    /// Decodes an object identifier from 32 bits.
    pub fn from_bits(bits: u32) -> ObjectId {
        let kind = ObjectType(u16::try_from(bits >> 22).unwrap_or_default());
        ObjectId::new(kind, bits & 0x3F_FFFF)
    }
}

impl fmt::Display for ObjectId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.kind.short() {
            "?" => write!(f, "object {}:{}", self.kind.0, self.instance),
            short => write!(f, "{short} {}", self.instance),
        }
    }
}

macro_rules! properties {
    ($($name:ident $number:literal,)*) => {
        /// Number of a property.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub struct PropertyId(pub u32);

        #[allow(missing_docs)]
        impl PropertyId {
            $(pub const $name: PropertyId = PropertyId($number);)*
        }
    };
}

properties! {
    ACTIVE_TEXT 4, ALL 8, APDU_SEGMENT_TIMEOUT 10, APDU_TIMEOUT 11, APPLICATION_SOFTWARE_VERSION 12,
    COV_INCREMENT 22, DAYLIGHT_SAVINGS_STATUS 24, DESCRIPTION 28, DEVICE_ADDRESS_BINDING 30, EVENT_STATE 36,
    FIRMWARE_REVISION 44, INACTIVE_TEXT 46, LOCAL_DATE 56, LOCAL_TIME 57,
    MAX_APDU_LENGTH_ACCEPTED 62, MAX_PRES_VALUE 65, MIN_PRES_VALUE 69, MODEL_NAME 70,
    NUMBER_OF_APDU_RETRIES 73, NUMBER_OF_STATES 74, OBJECT_IDENTIFIER 75, OBJECT_LIST 76, OBJECT_NAME 77,
    OBJECT_TYPE 79, OPTIONAL 80, OUT_OF_SERVICE 81, POLARITY 84, PRESENT_VALUE 85, PRIORITY_ARRAY 87,
    PROTOCOL_OBJECT_TYPES_SUPPORTED 96, PROTOCOL_SERVICES_SUPPORTED 97, PROTOCOL_VERSION 98, RELIABILITY 103,
    RELINQUISH_DEFAULT 104, REQUIRED 105, RESOLUTION 106, SEGMENTATION_SUPPORTED 107, STATE_TEXT 110,
    STATUS_FLAGS 111, SYSTEM_STATUS 112, UNITS 117, UTC_OFFSET 119, VENDOR_IDENTIFIER 120, VENDOR_NAME 121,
    PROTOCOL_REVISION 139, ACTIVE_COV_SUBSCRIPTIONS 152, DATABASE_REVISION 155, MAX_SEGMENTS_ACCEPTED 167,
    PROPERTY_LIST 371, APDU_LENGTH 399, IP_ADDRESS 400, IP_DEFAULT_GATEWAY 401,
    BACNET_IP_MODE 408, BACNET_IP_UDP_PORT 412, CHANGES_PENDING 416, FD_BBMD_ADDRESS 418,
    FD_SUBSCRIPTION_LIFETIME 419, IP_SUBNET_MASK 411, LINK_SPEED 420, MAC_ADDRESS 423, NETWORK_NUMBER 425,
    NETWORK_NUMBER_QUALITY 426, NETWORK_TYPE 427, PROTOCOL_LEVEL 482, CURRENT_COMMAND_PRIORITY 431,
    COMMAND_TIME_ARRAY 430, LAST_COMMAND_TIME 432, VALUE_SOURCE 433, VALUE_SOURCE_ARRAY 434,
    VALUE_TIME 512,
}

/// Class of a BACnet error.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum ErrorClass {
    Device = 0,
    Object = 1,
    Property = 2,
    Resources = 3,
    Security = 4,
    Services = 5,
    Communication = 7,
}

/// An error in the form in which a confirmed service returns it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Error {
    /// Class of the error.
    pub class: ErrorClass,
    /// Code of the error.
    pub code: u16,
}

macro_rules! errors {
    ($($name:ident $class:ident $code:literal,)*) => {
        #[allow(missing_docs)]
        impl Error {
            $(pub const $name: Error = Error { class: ErrorClass::$class, code: $code };)*
        }
    };
}

errors! {
    UNKNOWN_OBJECT Object 31, UNKNOWN_PROPERTY Property 32, INVALID_DATA_TYPE Property 9,
    VALUE_OUT_OF_RANGE Property 37, WRITE_ACCESS_DENIED Property 40, INVALID_ARRAY_INDEX Property 42,
    NOT_AN_ARRAY Property 50, NOT_COV_PROPERTY Property 44, PARAMETER_OUT_OF_RANGE Services 80,
    SERVICE_REQUEST_DENIED Services 29, OPERATIONAL_PROBLEM Device 25, TIMEOUT Communication 30,
    PASSWORD_FAILURE Security 26, NO_SPACE_TO_ADD_LIST_ELEMENT Resources 19,
}

/// Why a request cannot be parsed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum Reject {
    Other = 0,
    BufferOverflow = 1,
    InvalidParameterDataType = 3,
    InvalidTag = 4,
    MissingRequiredParameter = 5,
    ParameterOutOfRange = 6,
    TooManyArguments = 7,
    UndefinedEnumeration = 8,
    UnrecognizedService = 9,
}

/// The reason why a transaction is aborted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum Abort {
    Other = 0,
    BufferOverflow = 1,
    InvalidApdu = 2,
    SegmentationNotSupported = 4,
    OutOfResources = 9,
    ApduTooLong = 11,
}

/// The address of a station on its own network, at most eight octets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Mac {
    len: u8,
    octets: [u8; 8],
}

impl Mac {
    /// The MAC address that means all stations.
    pub const ALL: Mac = Mac { len: 0, octets: [0; 8] };

    /// A MAC address with these octets; `None` if there are more than eight.
    pub fn new(octets: &[u8]) -> Option<Mac> {
        let mut mac = Mac::ALL;
        mac.octets.get_mut(..octets.len())?.copy_from_slice(octets);
        mac.len = u8::try_from(octets.len()).ok()?;
        Some(mac)
    }

    /// The octets of the MAC address.
    pub fn octets(&self) -> &[u8] {
        self.octets.get(..usize::from(self.len)).unwrap_or_default()
    }
}

/// Sender or destination of a message: a host of this network, or a station behind a router at that host.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Address {
    /// UDP address of the host.
    pub host: SocketAddrV4,
    /// Network and station, if behind a router.
    pub remote: Option<(u16, Mac)>,
}

impl Address {
    /// A host of this network.
    pub fn local(host: SocketAddrV4) -> Address {
        Address { host, remote: None }
    }

    /// The address of the host.
    pub fn ip(&self) -> Ipv4Addr {
        *self.host.ip()
    }

    /// Network and station behind the host, as text; empty for the host itself.
    pub fn remote_text(&self) -> String {
        let text = self.to_string();
        text.split_once(' ').map_or(String::new(), |(_, rest)| rest.to_string())
    }

    /// The host's address and port as six octets.
    pub fn host_octets(host: SocketAddrV4) -> [u8; 6] {
        let [a, b, c, d] = host.ip().octets();
        let [high, low] = host.port().to_be_bytes();
        [a, b, c, d, high, low]
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.host)?;
        if let Some((network, mac)) = &self.remote {
            write!(f, " network {network} station ")?;
            mac.octets().iter().try_for_each(|octet| write!(f, "{octet:02x}"))?;
        }
        Ok(())
    }
}

impl FromStr for Address {
    type Err = ();

    /// Parses the text that `Display` writes.
    fn from_str(text: &str) -> Result<Address, ()> {
        let mut words = text.split(' ');
        let host = words.next().and_then(|host| host.parse().ok()).ok_or(())?;
        let rest: Vec<&str> = words.collect();
        let remote = match rest.as_slice() {
            [] => None,
            ["network", network, "station", mac] if mac.is_ascii() => {
                let pairs = mac
                    .as_bytes()
                    .chunks(2)
                    .map(|pair| std::str::from_utf8(pair).unwrap_or(""));
                let octets: Result<Vec<u8>, _> = pairs.map(|pair| u8::from_str_radix(pair, 16)).collect();
                let mac = octets.ok().and_then(|octets| Mac::new(&octets)).ok_or(())?;
                Some((network.parse().map_err(|_| ())?, mac))
            }
            _ => return Err(()),
        };
        Ok(Address { host, remote })
    }
}

/// Day and time of day, UTC.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DateTime {
    /// Year, month, day, day of the week (1 is Monday), as on the wire.
    pub date: [u8; 4],
    /// Hour, minute, second, hundredths.
    pub time: [u8; 4],
}

impl DateTime {
    /// A time of which every part is unspecified.
    pub const UNSPECIFIED: DateTime = DateTime {
        date: [0xFF; 4],
        time: [0xFF; 4],
    };

    /// The date and time at this number of milliseconds after 1970; unspecified beyond the years that a BACnet date can
    /// represent.
    pub fn from_unix_ms(ms: u64) -> DateTime {
        let (days, of_day) = (ms / 86_400_000, ms % 86_400_000);
        // Days since 0000-03-01, in eras of 400 years.
        let shifted = days + 719_468;
        let era_day = shifted % 146_097;
        let year_of_era = (era_day - era_day / 1460 + era_day / 36_524 - era_day / 146_096) / 365;
        let year_day = era_day - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
        let shifted_month = (5 * year_day + 2) / 153;
        let day = year_day - (153 * shifted_month + 2) / 5 + 1;
        let month = if shifted_month < 10 {
            shifted_month + 3
        } else {
            shifted_month - 9
        };
        let year = year_of_era + shifted / 146_097 * 400 + u64::from(month <= 2);
        let weekday = (days + 3) % 7 + 1;
        let octet = |value: u64| u8::try_from(value).unwrap_or(0xFF);
        match year.checked_sub(1900).filter(|year| *year < 255) {
            None => DateTime::UNSPECIFIED,
            Some(year) => DateTime {
                date: [octet(year), octet(month), octet(day), octet(weekday)],
                time: [
                    octet(of_day / 3_600_000),
                    octet(of_day / 60_000 % 60),
                    octet(of_day / 1000 % 60),
                    octet(of_day / 10 % 100),
                ],
            },
        }
    }
}

/// A primitive value that a client writes.
#[derive(Debug, Clone, PartialEq)]
pub enum Data {
    /// NULL, which releases a slot of a priority array.
    Null,
    /// BOOLEAN.
    Bool(bool),
    /// An Unsigned value.
    Unsigned(u64),
    /// INTEGER.
    Signed(i64),
    /// REAL.
    Real(f32),
    /// A Double value.
    Double(f64),
    /// A CharacterString value.
    Text(String),
    /// ENUMERATED.
    Enumerated(u32),
    /// A BACnetObjectIdentifier value.
    Object(ObjectId),
    /// A valid value of another type, which nothing here takes.
    Other,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn days_of_the_calendar() {
        for (ms, date, time) in [
            (0, [70, 1, 1, 4], [0, 0, 0, 0]),
            (951_782_400_000, [100, 2, 29, 2], [0, 0, 0, 0]),
            (1_795_810_983_450, [126, 11, 27, 5], [20, 23, 3, 45]),
        ] {
            assert_eq!(DateTime::from_unix_ms(ms), DateTime { date, time }, "{ms}");
        }
        assert_eq!(DateTime::from_unix_ms(u64::MAX), DateTime::UNSPECIFIED);
    }

    #[test]
    fn addresses_are_read_as_they_are_shown() {
        let host = "10.0.0.7:47808".parse().unwrap();
        for remote in [None, Some((5, Mac::new(&[0x0A, 0xFF]).unwrap())), Some((7, Mac::ALL))] {
            let address = Address { host, remote };
            assert_eq!(address.to_string().parse(), Ok(address), "{address}");
        }
        assert!("10.0.0.7:47808 network 5".parse::<Address>().is_err());
        assert!("10.0.0.7".parse::<Address>().is_err());
    }

    #[test]
    fn identifiers_on_the_wire() {
        let id = ObjectId::new(ObjectType::DEVICE, 4_194_303);
        assert_eq!(id.bits(), 0x023F_FFFF);
        assert_eq!(ObjectId::from_bits(id.bits()), id);
        assert_eq!(ObjectId::new(ObjectType(999), 1).to_string(), "object 999:1");
        assert!(Mac::new(&[1; 9]).is_none());
    }
}
