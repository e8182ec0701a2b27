use proptest::prelude::*;

use super::command::{CHECKSUM, DATA, OVERRUN, SIZE, UNKNOWN};
use super::*;

fn with_cr(text: &str) -> Vec<u8> {
    let mut bytes = text.as_bytes().to_vec();
    bytes.push(b'\r');
    bytes
}

fn object(region: Region, number: u8) -> Object {
    Object { region, number }
}

fn ai(number: u8) -> Object {
    object(Region::Ai, number)
}

fn read(object: Object, attribute: u8) -> Command {
    Command::Read { object, attribute }
}

fn float(value: f32) -> Vec<u8> {
    value.to_be_bytes().to_vec()
}

fn set(object: Object, data: Vec<u8>) -> Command {
    Command::Override { object, data }
}

/// All requests of reference/n2.md section 1 and reference/drives.md 6.8, encoded and decoded.
#[test]
fn requests_of_the_reference() {
    use RegionWidth::{One, Two};
    let (ao, bo) = (object(Region::Ao, 1), object(Region::Bo, 1));
    let write = |object, attribute, data| Command::Write {
        object,
        attribute,
        data,
    };
    let cases = [
        (0x01, Command::Identify, Two, ">01FA7"),
        (0x14, Command::Identify, Two, ">14FAB"),
        (0x01, Command::Poll { again: false }, Two, ">0104C5"),
        (0x01, Command::Poll { again: true }, Two, ">0105C6"),
        (0x14, Command::Poll { again: false }, Two, ">1404C9"),
        (0x01, Command::WarmReset, Two, ">0108C9"),
        (0x01, Command::Status, Two, ">0109CA"),
        (0x01, read(ai(2), 3), Two, ">0111020388"),
        (0x01, read(ai(1), 1), Two, ">0111010185"),
        (0x01, read(object(Region::Bi, 2), 2), Two, ">0112020288"),
        (0x01, read(object(Region::Adf, 5), 2), Two, ">011505028E"),
        (0x01, read(object(Region::Adi, 1), 2), Two, ">011601028B"),
        (0x01, read(object(Region::Bd, 111), 2), Two, ">01176F02A7"),
        (0x01, write(ai(2), 11, float(60.0)), Two, ">0121020B4270000025"),
        (0x01, write(ai(1), 1, vec![1]), Two, ">0121010101E7"),
        (
            0x01,
            write(object(Region::Adf, 5), 2, float(1.5)),
            Two,
            ">0125053FC00000D9",
        ),
        (0x01, set(ao, float(50.0)), Two, ">017203014248000020"),
        (0x01, set(ao, float(50.0)), One, ">017230142480000F0"),
        (0x01, set(bo, vec![1]), Two, ">0172040101F0"),
        (0x01, set(bo, vec![1]), One, ">017240101C0"),
        (0x01, set(bo, vec![0]), Two, ">0172040100EF"),
        (0x01, set(bo, vec![0]), One, ">017240100BF"),
        (0x01, Command::Release { object: ao }, Two, ">017303018F"),
        (0x01, Command::Release { object: ao }, One, ">01733015F"),
        (0x01, Command::Release { object: bo }, Two, ">0173040190"),
        (0x01, Command::Release { object: bo }, One, ">017340160"),
    ];
    for (address, command, width, text) in cases {
        let mut frame = Vec::new();
        command.encode(address, width, &mut frame);
        assert_eq!(frame, with_cr(text), "{command:?}");
        assert_eq!(Command::decode(&frame), Some((address, Ok(command))), "{text}");
    }
    assert_eq!(
        Command::decode(b">01fc7\r"),
        Some((1, Ok(Command::Identify))),
        "lower case"
    );
}

fn asked(pdu: RequestPdu) -> Request {
    Request::new(1, pdu)
}

fn reading(table: Table, start: u16, count: u16) -> Request {
    asked(RequestPdu::read(table, start, count))
}

fn answered(request: &Request, text: &str) -> Decoded {
    decode_reply(request, &with_cr(text))
}

fn regular(text: &str, reply: Reply) -> Decoded {
    let used = text.len() + 1;
    Decoded::Reply { used, reply }
}

/// All replies of reference/n2.md section 1 and reference/drives.md 6.8, as the master decodes them.
#[test]
fn replies_of_the_reference() {
    let words = |high, low| Reply::Registers(vec![high, low]);
    let ai2 = reading(Table::Input, 2, 2);
    let bi2 = reading(Table::DiscreteInput, 1, 1);
    let adi1 = reading(Table::Input, 0x4000, 1);
    let identify = asked(RequestPdu::N2(Session::Identify));
    let poll = asked(RequestPdu::N2(Session::Poll { again: false }));
    let start = asked(RequestPdu::WriteCoil { address: 0, on: true });
    let refused = |code| Reply::Exception(Exception::N2(code));
    for (request, text, reply) in [
        (&ai2, "A4248000092", words(0x4248, 0)),
        (&ai2, "A0042480000F2", words(0x4248, 0)),
        (&ai2, "A41C80000A0", words(0x41C8, 0)),
        (&ai2, "a41c80000c0", words(0x41C8, 0)),
        (&ai2, "A3FC00000AC", words(0x3FC0, 0)),
        (&ai2, "A003FC000000C", words(0x3FC0, 0)),
        (&bi2, "A0060", Reply::Bits(vec![false])),
        (&bi2, "A4064", Reply::Bits(vec![true])),
        (&adi1, "A0035C8", Reply::Registers(vec![53])),
        (&adi1, "A00003528", Reply::Registers(vec![53])),
        (&identify, "A1061", Reply::Identified(0x10)),
        (&poll, "A", Reply::Changes(vec![])),
        (&poll, "A10240F7", Reply::Changes(b"10240".to_vec())),
        (&start, "A", Reply::Written),
        (&start, "N11", refused(0x11)),
        (&start, "N1162", refused(0x11)),
        (&ai2, "N00", Reply::Exception(Exception::N2_RESTARTED)),
        (&ai2, "n10", refused(0x10)),
    ] {
        assert_eq!(answered(request, text), regular(text, reply), "{text} to {request:?}");
    }
}

#[test]
fn requests_of_the_master() {
    let frame = |pdu| {
        let mut out = Vec::new();
        encode_request(&asked(pdu), &mut out);
        String::from_utf8(out).unwrap()
    };
    let read = |table, start, count| frame(RequestPdu::Read { table, start, count });
    assert_eq!(read(Table::Input, 2, 2), ">0111020388\r");
    assert_eq!(read(Table::DiscreteInput, 1, 1), ">0112020288\r");
    assert_eq!(read(Table::Input, 0x4000, 1), ">011601028B\r");
    let ao = RequestPdu::write_registers(0, &[0x4248, 0]);
    assert_eq!(frame(ao.clone()), ">017203014248000020\r");
    let mut out = Vec::new();
    let narrow = Request {
        n2: N2Options {
            region_width: RegionWidth::One,
            ..N2Options::DEFAULT
        },
        ..asked(ao)
    };
    encode_request(&narrow, &mut out);
    assert_eq!(out, b">017230142480000F0\r");
    let (table, address) = (Table::Holding, 0);
    assert_eq!(
        frame(RequestPdu::N2(Session::Release { table, address })),
        ">017303018F\r"
    );
    // Requests that do not address exactly one object have no frame.
    for (table, start, count) in [
        (Table::Input, 1, 2),
        (Table::Input, 2, 1),
        (Table::Input, 2, 4),
        (Table::Input, 0x4000, 2),
        (Table::Input, 510, 2),
        (Table::Holding, 0xFFFE, 2),
        (Table::Coil, 255, 1),
        (Table::Coil, 0, 2),
        (Table::DiscreteInput, 0xFFFF, 1),
    ] {
        assert_eq!(read(table, start, count), "", "{table} {start} {count}");
    }
    assert_eq!(frame(RequestPdu::write_register(0, 1)), "");
    assert_eq!(
        frame(RequestPdu::Diagnostics {
            subfunction: 0,
            data: 0
        }),
        ""
    );
}

fn corrupt(request: &Request, bytes: &[u8]) -> bool {
    matches!(decode_reply(request, bytes), Decoded::Corrupt(_))
}

#[test]
fn what_cannot_be_the_reply() {
    let ai2 = reading(Table::Input, 2, 2);
    let bi2 = reading(Table::DiscreteInput, 1, 1);
    let adi1 = reading(Table::Input, 0x4000, 1);
    let identify = asked(RequestPdu::N2(Session::Identify));
    let start = asked(RequestPdu::WriteCoil { address: 0, on: true });
    let wrong: [(&Request, &str); 16] = [
        (&ai2, "A4248000093"),
        (&ai2, "A"),
        (&ai2, "A0060"),
        (&ai2, "A0035C8"),
        (&ai2, "A1061"),
        (&bi2, "A4248000092"),
        (&bi2, "A0035C8"),
        (&adi1, "A4064"),
        (&identify, "A4248000092"),
        (&identify, "A"),
        (&start, "A4248000092"),
        (&start, "N02"),
        (&start, "N1"),
        (&start, "N1163"),
        (&ai2, "A10240F7"),
        (&ai2, "X1061"),
    ];
    for (request, text) in wrong {
        assert!(corrupt(request, &with_cr(text)), "{text}");
    }
    assert!(corrupt(&ai2, b"\xC1A\xB0\r"), "8-bit garbage");
    assert!(corrupt(&ai2, b"Ahello"), "before the CR");
    assert!(corrupt(&ai2, &[b'A'; 300]), "no CR");
    assert!(corrupt(&ai2, &[0; 300]), "nothing but silence");
    assert_eq!(decode_reply(&ai2, b"A42480"), Decoded::Incomplete);
    assert_eq!(decode_reply(&ai2, b""), Decoded::Incomplete);
    assert_eq!(
        decode_reply(&ai2, b">0111020388\r"),
        Decoded::Foreign { used: 12 },
        "an echo"
    );
    let glitch = b"\x00\xFF\r\nA4248000092\r";
    assert!(matches!(decode_reply(&ai2, glitch), Decoded::Reply { used: 16, .. }));
}

#[test]
fn no_number_is_passed_as_it_came() {
    let ai2 = reading(Table::Input, 2, 2);
    for bits in [0x7FC0_0000u32, 0x7F80_0000, 0xFF80_0000, 0xFFFF_FFFF] {
        let mut frame = Vec::new();
        Answer::bytes(&bits.to_be_bytes()).encode(&mut frame);
        let words = vec![(bits >> 16) as u16, bits as u16];
        assert!(matches!(decode_reply(&ai2, &frame), Decoded::Reply { reply: Reply::Registers(w), .. } if w == words));
    }
}

#[test]
fn status_bits_are_options() {
    let mut request = reading(Table::Coil, 0, 1);
    request.n2.state_bit = 0;
    assert_eq!(answered(&request, "A0161"), regular("A0161", Reply::Bits(vec![true])));
    assert_eq!(answered(&request, "A4064"), regular("A4064", Reply::Bits(vec![false])));
    request.n2.unreliable_bit = Some(7);
    let unreliable = Reply::Exception(Exception::DEVICE_FAILURE);
    assert_eq!(answered(&request, "A8169"), regular("A8169", unreliable));
}

#[test]
fn what_a_drive_refuses_or_ignores() {
    let refused = |code| Some((1, Err(code)));
    assert_eq!(Command::decode(b">01FA8\r"), refused(CHECKSUM));
    assert_eq!(Command::decode(b">01EA6\r"), refused(UNKNOWN));
    assert_eq!(Command::decode(b">0118020300\r"), refused(CHECKSUM));
    let sealed = |body: &str| {
        let check = command::checksum(body.as_bytes());
        format!(">{body}{check:02X}\r").into_bytes()
    };
    assert_eq!(Command::decode(&sealed("01180203")), refused(DATA), "no region 8");
    assert_eq!(Command::decode(&sealed("01110203AA")), refused(SIZE));
    assert_eq!(
        Command::decode(&sealed("0111020")),
        refused(SIZE),
        "an odd number of digits"
    );
    assert_eq!(Command::decode(&sealed("0144")), refused(UNKNOWN));
    assert_eq!(
        Command::decode(&sealed("01001234567")),
        Some((1, Ok(Command::SyncTime)))
    );
    for other in ["0177", "0178AB", "018101", "0199"] {
        assert_eq!(
            Command::decode(&sealed(other)),
            Some((1, Ok(Command::Other))),
            "{other}"
        );
    }
    assert_eq!(
        Command::decode(&sealed(&format!("0100{}", "0".repeat(248)))),
        Some((1, Ok(Command::SyncTime)))
    );
    assert_eq!(
        Command::decode(&sealed(&format!("0100{}", "0".repeat(260)))),
        refused(OVERRUN)
    );
    for silent in [
        &b"01FA7\r"[..],
        b">01FA7",
        b">G1FA7\r",
        b">0\r",
        b">\r",
        b"\r",
        b"",
        b">01 FA7\r",
    ] {
        assert_eq!(Command::decode(silent), None);
    }
    assert_eq!(
        Command::decode(b">0111>01FA7\r"),
        Some((1, Ok(Command::Identify))),
        "begun anew"
    );
}

#[test]
fn lengths_for_the_prediction() {
    let read = |table, start, count| RequestPdu::Read { table, start, count };
    let float = read(Table::Input, 2, 2);
    assert_eq!(
        (request_chars(&float), reply_chars(&float), least_reply_chars(&float)),
        (12, 14, 12)
    );
    let state = read(Table::Coil, 0, 1);
    assert_eq!((reply_chars(&state), least_reply_chars(&state)), (6, 6));
    let poll = RequestPdu::N2(Session::Poll { again: false });
    assert_eq!(
        (request_chars(&poll), reply_chars(&poll), least_reply_chars(&poll)),
        (8, 204, 2)
    );
    assert_eq!(reply_chars(&RequestPdu::WriteCoil { address: 0, on: true }), 2);
}

#[test]
fn modbus_never_says_what_only_n2_says() {
    use crate::Protocol;
    for session in [Session::Identify, Session::Poll { again: true }] {
        let request = asked(RequestPdu::N2(session));
        for protocol in [Protocol::ModbusRtu, Protocol::ModbusAscii] {
            let mut out = Vec::new();
            protocol.encode(&request, &mut out);
            assert!(out.is_empty());
            assert!(!matches!(
                protocol.decode(&request, b"\x01\x00\x00\x00\x00"),
                Decoded::Reply { .. }
            ));
        }
        let mut out = Vec::new();
        Reply::Identified(1).encode(&request.pdu, &mut out);
        assert_eq!(out, [0x80, 1]);
    }
}

fn any_object() -> impl Strategy<Value = Object> {
    (1u8..=7, any::<u8>()).prop_map(|(region, number)| object(Region::from_number(region).unwrap(), number))
}

fn any_command() -> impl Strategy<Value = Command> {
    let data = || proptest::collection::vec(any::<u8>(), 0..5);
    prop_oneof![
        Just(Command::Identify),
        any::<bool>().prop_map(|again| Command::Poll { again }),
        Just(Command::WarmReset),
        (any_object(), any::<u8>()).prop_map(|(object, attribute)| read(object, attribute)),
        (any_object(), data()).prop_map(|(object, data)| Command::Write {
            attribute: if object.region.is_internal() { 2 } else { 3 },
            object,
            data,
        }),
        (any_object(), data()).prop_map(|(object, data)| set(object, data)),
        any_object().prop_map(|object| Command::Release { object }),
    ]
}

proptest! {
    #[test]
    fn commands_round_trip(address: u8, command in any_command(), narrow: bool) {
        let width = if narrow { RegionWidth::One } else { RegionWidth::Two };
        let mut frame = Vec::new();
        command.encode(address, width, &mut frame);
        prop_assert_eq!(Command::decode(&frame), Some((address, Ok(command))));
    }

    #[test]
    fn objects_round_trip(table in 0usize..4, address: u16) {
        let table = [Table::Coil, Table::DiscreteInput, Table::Input, Table::Holding][table];
        if let Some(object) = Object::containing(table, address) {
            prop_assert_eq!(object.place(), Some((table, address)));
        }
    }

    #[test]
    fn anything_is_read_without_a_panic(
        bytes in proptest::collection::vec(any::<u8>(), 0..300),
        text in "[AN>0-9A-Fa-f\r]{0,40}",
        start: u16,
    ) {
        for bytes in [bytes.as_slice(), text.as_bytes()] {
            let _ = Command::decode(bytes);
            for request in [reading(Table::Input, start, 2), asked(RequestPdu::N2(Session::Poll { again: true }))] {
                if let Decoded::Reply { used, .. } | Decoded::Foreign { used } = decode_reply(&request, bytes) {
                    prop_assert!(used > 0 && used <= bytes.len());
                }
            }
        }
    }
}

/// Danfoss and GE count objects from 0 (object 1 of their maps is 0 on the wire).
#[test]
fn objects_of_a_family_that_counts_from_zero() {
    let of = |first_object, pdu: &RequestPdu| {
        let mut frame = Vec::new();
        let n2 = N2Options {
            first_object,
            ..N2Options::DEFAULT
        };
        let request = Request {
            address: 5,
            pdu: pdu.clone(),
            n2,
        };
        encode_request(&request, &mut frame);
        String::from_utf8(frame).unwrap()
    };
    let read = RequestPdu::read(Table::Input, 2, 2);
    assert!(of(1, &read).starts_with(">051102"), "{}", of(1, &read));
    assert!(of(0, &read).starts_with(">051101"), "{}", of(0, &read));
    let first = RequestPdu::WriteCoil { address: 0, on: true };
    assert!(of(1, &first).contains("01") && of(0, &first) != of(1, &first));
    let identify = RequestPdu::N2(Session::Identify);
    assert_eq!(of(0, &identify), of(1, &identify));
}
