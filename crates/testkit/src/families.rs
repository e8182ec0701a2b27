//! How to command the families whose profiles come from reports, taken by hand from the figures of their manuals.

use drivegate_proto::RequestPdu;

/// A write to a drive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// A register written with function 06.
    Word(u16, u16),
    /// A register written with function 16.
    Single(u16, u16),
    /// Two registers written by function 16.
    Pair(u16, u16, u16),
    /// A coil written with function 05.
    Coil(u16, bool),
}

impl Order {
    /// The request of the order.
    pub fn pdu(self) -> RequestPdu {
        match self {
            Order::Word(address, value) => RequestPdu::write_register(address, value),
            Order::Single(start, value) => RequestPdu::write_registers(start, &[value]),
            Order::Pair(start, high, low) => RequestPdu::write_registers(start, &[high, low]),
            Order::Coil(address, on) => RequestPdu::WriteCoil { address, on },
        }
    }
}

/// Orders as the tables write them: `8501=6,7` is two words to one register, `2=[2500]` and `0=[0,2500]` use
/// function 16, `3=on` is a coil.
pub fn orders(text: &str) -> Vec<Order> {
    let each = text.split_whitespace().map(|part| {
        let (address, values) = part.split_once('=').unwrap();
        let address = number(address);
        let block = values.strip_prefix('[').and_then(|values| values.strip_suffix(']'));
        match (values, block.map(|block| block.split_once(','))) {
            ("on" | "off", _) => vec![Order::Coil(address, values == "on")],
            (_, Some(Some((high, low)))) => vec![Order::Pair(address, number(high), number(low))],
            (_, Some(None)) => vec![Order::Single(address, number(block.unwrap()))],
            (_, None) => values
                .split(',')
                .map(|value| Order::Word(address, number(value)))
                .collect(),
        }
    });
    each.flatten().collect()
}

/// A number of a table: decimal, or hexadecimal after `0x`.
pub fn number(text: &str) -> u16 {
    let text = text.trim();
    let number = match text.strip_prefix("0x") {
        Some(digits) => u16::from_str_radix(digits, 16),
        None => text.parse(),
    };
    number.unwrap()
}

/// The rows of a table with `|` between its cells.
pub fn rows<const CELLS: usize>(table: &'static str) -> Vec<[&'static str; CELLS]> {
    let cells = |row: &'static str| row.split('|').map(str::trim).collect::<Vec<_>>();
    table.lines().map(|row| cells(row).try_into().unwrap()).collect()
}

/// How to command a family.
pub struct Family {
    /// Name of the family's profile.
    pub profile: &'static str,
    /// Half the maximum forward: 10000 of 20000, 0x2000 of 0x4000, 25 Hz of 50 Hz.
    pub reference: Vec<Order>,
    /// Orders that start the motor forward.
    pub start: Vec<Order>,
    /// Orders that stop the motor.
    pub stop: Vec<Order>,
    /// Orders that reverse the motor; empty where the profile cannot do that.
    pub reverse: Vec<Order>,
}

/// Profile, half the maximum forward, start, stop, reverse.
const FAMILIES: &str = "\
abb-acs550         | 1=10000      | 0=0x47E,0x47F  | 0=0x47E       | 1=0xD8F0 0=0x47F
abb-acs580         | 1=10000      | 0=0x47E,0x47F  | 0=0x47E       | 1=0xD8F0 0=0x47F
danfoss-fc         | 50009=0x2000 | 49999=0x47C    | 49999=0x43C   | 49999=0x847C
siemens-v20        | 100=0x2000   | 99=0x47E,0x47F | 99=0x47E      | 99=0xC7F
siemens-g120       | 100=0x2000   | 99=0x47E,0x47F | 99=0x47E      | 100=0xE000 99=0x47F
schneider-altivar  | 8502=250     | 8501=6,7,15    | 8501=7        | 8501=0x80F
yaskawa-v1000      | 2=[2500]     | 1=[1]          | 1=[0]         | 1=[2]
delta-ms300        | 0x2001=2500  | 0x2000=0x12    | 0x2000=1      | 0x2000=0x22
invt-goodrive      | 0x2001=2500  | 0x2000=1       | 0x2000=5      | 0x2000=2
mitsubishi-d700    | 13=2500      | 8=2            | 8=0           | 8=4
invertek-optidrive | 1=250        | 0=1            | 0=0           | 1=0xFF06 0=1
weg-cfw            | 683=4096     | 682=0x17       | 682=0x16      | 682=0x13
fuji-frenic        | 0x0705=2500  | 0x0706=1       | 0x0706=0      | 0x0706=2
hitachi-wj200      | 0=[0,2500]   | 1=off 0=on     | 0=off         | 1=on 0=on
toshiba-vf-s15     | 0xFA01=2500  | 0xFA00=0xC400  | 0xFA00=0xC000 | 0xFA00=0xC600
ls-g100            | 4=2500       | 5=2            | 5=1           | 5=4
teco-f510          | 0x2502=2500  | 0x2501=1       | 0x2501=0      | 0x2501=3
vacon-10           | 2002=5000    | 2000=1         | 2000=0        | 2000=3";

/// All families with built-in profiles and their orders.
pub fn families() -> Vec<Family> {
    let family = |[profile, reference, start, stop, reverse]: [&'static str; 5]| Family {
        profile,
        reference: orders(reference),
        start: orders(start),
        stop: orders(stop),
        reverse: orders(reverse),
    };
    rows(FAMILIES).into_iter().map(family).collect()
}
