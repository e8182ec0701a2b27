use super::super::{ascii, n2, rtu};
use super::*;
use proptest::prelude::*;

const RTU: Protocol = Protocol::ModbusRtu;

fn hex(text: &str) -> Vec<u8> {
    text.split_whitespace()
        .map(|b| u8::from_str_radix(b, 16).unwrap())
        .collect()
}

fn asked(frame: &str) -> Request {
    let (address, pdu) = rtu::decode_request(&hex(frame)).unwrap();
    Request::new(address, pdu.unwrap())
}

fn framed(address: u8, pdu: &str) -> Vec<u8> {
    let mut out = Vec::new();
    rtu::encode_frame(address, &hex(pdu), &mut out);
    out
}

/// Worked requests of reference/drives.md, section 7, misprints corrected.
#[test]
fn requests_of_the_reference() {
    for (frame, text) in [
        ("01 03 07 D0 00 03 05 46", "read holding 2000..2002"),
        ("01 04 07 D0 00 01 31 47", "read input 2000"),
        ("01 06 07 D0 00 01 48 87", "write holding 2000 = 0x0001"),
        ("01 06 07 D2 EC 78 64 65", "write holding 2002 = 0xEC78"),
        (
            "01 10 07 D0 00 03 06 00 01 00 00 13 88 C8 CB",
            "write holding 2000..2002 = 0001 0000 1388",
        ),
        ("01 03 08 34 00 0B 47 A3", "read holding 2100..2110"),
        ("01 05 00 00 FF 00 8C 3A", "write coil 0 = on"),
        ("01 05 00 00 00 00 CD CA", "write coil 0 = off"),
        ("01 02 00 02 00 01 18 0A", "read discrete-input 2"),
    ] {
        assert_eq!(request(&asked(frame).pdu), text, "{frame}");
    }
}

#[test]
fn the_other_requests() {
    for (pdu, text) in [
        (
            RequestPdu::WriteCoils {
                start: 8,
                bits: vec![true, false, true, true, false, false, false, false, true],
            },
            "write coil 8..16 = 10110000 1",
        ),
        (
            RequestPdu::MaskWrite {
                address: 2000,
                and_mask: 0xFFF2,
                or_mask: 4,
            },
            "mask holding 2000: and 0xFFF2, or 0x0004",
        ),
        (
            RequestPdu::ReadWrite {
                read_start: 2100,
                read_count: 11,
                write_start: 2002,
                values: vec![5000],
            },
            "write holding 2002 = 1388, then read holding 2100..2110",
        ),
        (
            RequestPdu::Diagnostics {
                subfunction: 0,
                data: 0xA537,
            },
            "diagnostics 0: 0xA537",
        ),
        (
            RequestPdu::DeviceIdentification { code: 1, object: 0 },
            "device identification: code 1 from object 0",
        ),
        (
            RequestPdu::read(Table::Holding, u16::MAX, 2),
            "read holding 65535..65536",
        ),
    ] {
        assert_eq!(request(&pdu), text);
    }
}

#[test]
fn replies() {
    let eleven = format!("03 16 {}", "00 23 ".repeat(11));
    for (asked_for, pdu, text) in [
        (
            "03 07 D0 00 03",
            "03 06 00 23 20 00 13 88",
            "3 registers: 0023 2000 1388",
        ),
        ("04 07 D0 00 01", "04 02 00 23", "1 register: 0023"),
        (
            "03 08 34 00 0B",
            eleven.as_str(),
            "11 registers: 0023 0023 0023 0023 0023 0023 0023 0023 0023 0023 0023",
        ),
        ("01 00 00 00 0A", "01 02 05 02", "10 bits: 10100000 01"),
        ("06 07 D0 00 01", "06 07 D0 00 01", "written"),
        ("10 07 D0 00 01 02 00 01", "10 07 D0 00 01", "written"),
        ("03 17 70 00 05", "83 02", "exception 02 (illegal data address)"),
        ("08 00 00 A5 37", "08 00 00 A5 37", "diagnostics: 0xA537"),
        (
            "2B 0E 01 00",
            "2B 0E 01 01 00 00 02 00 02 4E 58 01 01 07",
            "device identification, 0 `NX`, 1 `.`",
        ),
    ] {
        let (address, decoded) = rtu::decode_request(&framed(1, asked_for)).unwrap();
        let asked = Request::new(address, decoded.unwrap());
        assert_eq!(reply(RTU, &asked, &framed(1, pdu)), text);
    }
}

#[test]
fn what_is_no_reply() {
    let asked = asked("01 03 07 D0 00 03 05 46");
    for (bytes, text) in [
        (
            framed(3, "03 04 00 01 00 02"),
            "foreign: address 3, function 3, 2 registers",
        ),
        (
            framed(3, "83 02"),
            "foreign: address 3, function 3, exception 02 (illegal data address)",
        ),
        (
            framed(1, "04 06 00 01 00 02 00 03"),
            "foreign: address 1, function 4, 3 registers",
        ),
        (framed(1, "03 02 00 01"), "foreign: address 1, function 3, 1 register"),
        (
            framed(1, "06 07 D0 00 01"),
            "foreign: address 1, function 6, 4 bytes of data",
        ),
        (hex("01 03 06 00"), "4 of 11 bytes"),
        (hex("01 03 06 00 23 20 00 13 88 00 00"), "11 bytes, no sound frame"),
        (Vec::new(), "0 of 11 bytes"),
    ] {
        assert_eq!(reply(RTU, &asked, &bytes), text);
    }
    assert_eq!(stray(RTU, &hex("FF")), "1 byte, no sound frame");
    assert_eq!(
        stray(RTU, &framed(2, "03 02 00 01")),
        "foreign: address 2, function 3, 1 register"
    );
}

#[test]
fn long_lists_end() {
    let words: Vec<u16> = (0..17).collect();
    assert!(word_list(&words).ends_with("000E 000F …"));
    assert!(word_list(&words[..16]).ends_with("000E 000F"));
    assert!(bit_list(&[true; 129]).ends_with("1 …"));
}

fn kinds(asked: &Request, bytes: &[u8], answered: bool) -> Vec<(Kind, usize)> {
    let mut frame = Vec::new();
    RTU.encode(asked, &mut frame);
    parts(RTU, asked, &frame, bytes, answered)
        .into_iter()
        .map(|part| (part.kind, part.range.len()))
        .collect()
}

#[test]
fn an_exchange_in_its_parts() {
    let read = asked("01 03 07 D0 00 01 84 87");
    let echo = hex("01 03 07 D0 00 01 84 87");
    let (own, other) = (framed(1, "03 02 00 23"), framed(3, "03 02 00 23"));
    assert_eq!(kinds(&read, &own, true), [(Kind::Reply, 7)]);
    let all = [echo.as_slice(), &other, &own, &[0xFF]].concat();
    assert_eq!(
        kinds(&read, &all, true),
        [
            (Kind::Echo, 8),
            (Kind::Foreign, 7),
            (Kind::Reply, 7),
            (Kind::Garbage, 1)
        ]
    );
    let noisy = [&[0xFF, 0x00], own.as_slice(), &other].concat();
    assert_eq!(
        kinds(&read, &noisy, true),
        [(Kind::Garbage, 2), (Kind::Reply, 7), (Kind::Foreign, 7)]
    );
    assert_eq!(kinds(&read, &own[..5], false), [(Kind::Garbage, 5)]);
    assert_eq!(kinds(&read, &[], false), []);

    let write = asked("01 06 07 D0 00 01 48 87");
    let frame = hex("01 06 07 D0 00 01 48 87");
    assert_eq!(kinds(&write, &frame, true), [(Kind::Reply, 8)]);
    assert_eq!(kinds(&write, &frame, false), [(Kind::Echo, 8)]);
    let twice = [frame.as_slice(), &frame].concat();
    assert_eq!(kinds(&write, &twice, true), [(Kind::Echo, 8), (Kind::Reply, 8)]);
    let write = asked("01 10 07 D0 00 02 04 00 01 00 10 88 CF");
    let all = [
        hex("01 10 07 D0 00 02 04 00 01 00 10 88 CF"),
        framed(1, "10 07 D0 00 02"),
    ]
    .concat();
    assert_eq!(kinds(&write, &all, true), [(Kind::Echo, 13), (Kind::Reply, 8)]);
    assert_eq!(kinds(&read, &noisy, false), [(Kind::Garbage, 16)]);
}

/// The parts of a transaction in Modbus ASCII: kind and length of each.
fn in_ascii(asked: &Request, bytes: &[u8], answered: bool) -> Vec<(Kind, usize)> {
    let mut frame = Vec::new();
    ascii::encode_request(asked, &mut frame);
    parts(Protocol::ModbusAscii, asked, &frame, bytes, answered)
        .into_iter()
        .map(|part| (part.kind, part.range.len()))
        .collect()
}

#[test]
fn ascii_exchanges_in_their_parts_and_words() {
    let ask = |text: &[u8]| {
        let (address, pdu) = ascii::decode_request(text).unwrap();
        Request::new(address, pdu.unwrap())
    };
    let echo = b":010300200002DA\r\n";
    let read = ask(echo);
    let own = b":01030400050000F3\r\n".as_slice();
    let other = b":0203020023D6\r\n".as_slice();
    assert_eq!(in_ascii(&read, own, true), [(Kind::Reply, 19)]);
    let all = [b"\xFF0:", echo.as_slice(), other, own, b":0"].concat();
    assert_eq!(
        in_ascii(&read, &all, true),
        [
            (Kind::Garbage, 3),
            (Kind::Echo, 17),
            (Kind::Foreign, 15),
            (Kind::Reply, 19),
            (Kind::Garbage, 2)
        ]
    );
    let broken = [b":01030400050000F4\r\n", own, other].concat();
    assert_eq!(
        in_ascii(&read, &broken, true),
        [(Kind::Garbage, 19), (Kind::Reply, 19), (Kind::Foreign, 15)]
    );
    assert_eq!(in_ascii(&read, b"\x80\x81", false), [(Kind::Garbage, 2)]);
    assert_eq!(in_ascii(&read, &own[..7], false), [(Kind::Garbage, 7)]);

    let words = |bytes| reply(Protocol::ModbusAscii, &read, bytes);
    assert_eq!(words(own), "2 registers: 0005 0000");
    assert_eq!(words(b":0183027A\r\n"), "exception 02 (illegal data address)");
    assert_eq!(words(other), "foreign: address 2, function 3, 1 register");
    assert_eq!(words(&own[..7]), "7 of 19 bytes");
    assert_eq!(words(b":01030400050000F4\r\n"), "19 bytes, no sound frame");
}

#[test]
fn text_is_shown_as_text() {
    assert_eq!(text(b":010300200002DA\r\n"), ":010300200002DA\u{240D}\u{240A}");
    assert_eq!(
        text(&[0, 0x1B, b' ', 0x7F, 0x80, 0xFF]),
        "\u{2400}\u{241B} \u{2421}\\x80\\xFF"
    );
    assert_eq!(text(b""), "");
}

proptest! {
    #[test]
    fn any_bytes_have_words_and_parts(
        bytes in proptest::collection::vec(prop_oneof![any::<u8>(), Just(b':'), Just(b'\n')], 0..300),
        answered: bool,
        protocol in prop_oneof![Just(RTU), Just(Protocol::ModbusAscii)],
    ) {
        let asked = asked("01 03 07 D0 00 03 05 46");
        prop_assert!(!reply(protocol, &asked, &bytes).is_empty());
        prop_assert!(!stray(protocol, &bytes).is_empty());
        let mut frame = Vec::new();
        protocol.encode(&asked, &mut frame);
        let mut at = 0;
        for part in parts(protocol, &asked, &frame, &bytes, answered) {
            prop_assert_eq!(part.range.start, at);
            prop_assert!(part.range.end > at);
            at = part.range.end;
        }
        prop_assert_eq!(at, bytes.len());
    }
}

#[test]
fn n2_in_the_words_of_its_objects() {
    let read = |table, start, count| RequestPdu::Read { table, start, count };
    let ao = RequestPdu::write_registers(0, &[0x4248, 0]);
    let bo = RequestPdu::WriteCoil { address: 0, on: true };
    let (table, address) = (Table::Holding, 0);
    let cases = [
        (read(Table::Input, 2, 2), "A41C80000A0\r", "read AI 2 value", "25"),
        (read(Table::DiscreteInput, 1, 1), "A4064\r", "read BI 2 state", "on"),
        (read(Table::Input, 0x4000, 1), "A0035C8\r", "read ADI 1 value", "53"),
        (ao, "A\r", "override AO 1 = 50", "acknowledged"),
        (
            bo,
            "N11\r",
            "override BO 1 = 1",
            "N11: invalid command for the data type, or only in PRGM mode (TECO, assumed)",
        ),
        (
            RequestPdu::N2(n2::Session::Release { table, address }),
            "A\r",
            "release AO 1",
            "acknowledged",
        ),
        (
            RequestPdu::N2(n2::Session::Identify),
            "A1061\r",
            "identify",
            "device type 10h",
        ),
        (
            RequestPdu::N2(n2::Session::Poll { again: false }),
            "A\r",
            "poll for changes",
            "nothing new",
        ),
    ];
    for (pdu, bytes, asked, reported) in cases {
        assert_eq!(request_on(Protocol::N2, &pdu), asked);
        assert_eq!(reply(Protocol::N2, &Request::new(1, pdu), bytes.as_bytes()), reported);
    }
    assert_eq!(stray(Protocol::N2, b">01FA7\r"), "foreign: a request to address 1");
    assert_eq!(stray(Protocol::N2, b"A1061\r"), "foreign: an unsolicited or late reply");
}
