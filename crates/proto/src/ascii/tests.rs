//! Frames of the reference, broken frames, and chance.

use super::super::modbus::{Exception, Table, encode_exception};
use super::*;
use proptest::prelude::*;

fn line(text: &str) -> Vec<u8> {
    [text.as_bytes(), b"\r\n"].concat()
}

fn to(address: u8, pdu: RequestPdu) -> Request {
    Request::new(address, pdu)
}

fn read(start: u16, count: u16) -> Request {
    to(1, RequestPdu::read(Table::Holding, start, count))
}

fn set(address: u16, value: u16) -> Request {
    to(1, RequestPdu::write_register(address, value))
}

fn write(start: u16, values: &[u16]) -> Request {
    to(1, RequestPdu::write_registers(start, values))
}

fn loop_test() -> Request {
    to(
        1,
        RequestPdu::Diagnostics {
            subfunction: 0,
            data: 0xAA55,
        },
    )
}

fn encoded(request: &Request) -> Vec<u8> {
    let mut out = Vec::new();
    encode_request(request, &mut out);
    out
}

fn framed(address: u8, pdu: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    encode_frame(address, pdu, &mut out);
    out
}

fn replied(request: &Request, reply: &Reply) -> Vec<u8> {
    let mut pdu = Vec::new();
    reply.encode(&request.pdu, &mut pdu);
    framed(request.address, &pdu)
}

/// Worked requests of reference/drives.md 7.3 and 7.4.
#[test]
fn requests_of_the_reference() {
    let broadcast = |address, value| to(0, RequestPdu::write_register(address, value));
    let input = to(1, RequestPdu::read(Table::Input, 0x20, 1));
    for (request, text) in [
        (loop_test(), ":01080000AA55F8"),
        (read(2, 1), ":010300020001F9"),
        (set(2, 6000), ":01060002177070"),
        (write(1, &[1]), ":011000010001020001EA"),
        (set(1, 1), ":010600010001F7"),
        (set(1, 3), ":010600010003F5"),
        (set(1, 0), ":010600010000F8"),
        (set(1, 8), ":010600010008F0"),
        (broadcast(1, 0), ":000600010000F9"),
        (broadcast(2, 5000), ":0006000213885D"),
        (read(0x20, 2), ":010300200002DA"),
        (read(0x23, 6), ":010300230006D3"),
        (read(0x2C, 1), ":0103002C0001CF"),
        (read(0x20, 16), ":010300200010CC"),
        (read(0x20, 17), ":010300200011CB"),
        (set(0x201, 600), ":0106020102589C"),
        (set(0x900, 0), ":010609000000F0"),
        (write(0x500, &[100, 100]), ":01100500000204006400641C"),
        (input, ":010400200001DA"),
    ] {
        assert_eq!(encoded(&request), line(text), "{text}");
        let decoded = decode_request(&line(text)).unwrap();
        assert_eq!(decoded, (request.address, Ok(request.pdu.clone())));
        assert_eq!(decode_request(&line(&text.to_lowercase())), Some(decoded));
        assert_eq!(request_len(&line(text)), Some(text.len() + 2));
        assert_eq!(chars(request.pdu.encoded_len()), text.len() + 2);
    }
}

/// Worked replies of reference/drives.md 7.3 and 7.4.
fn replies() -> Vec<(Request, &'static str, Reply)> {
    let refused = |code| Reply::Exception(Exception::Modbus(code));
    let input = to(1, RequestPdu::read(Table::Input, 0x20, 1));
    vec![
        (loop_test(), ":01080000AA55F8", Reply::Diagnostics(0xAA55)),
        (read(2, 1), ":010302177073", Reply::Registers(vec![6000])),
        (set(2, 6000), ":01060002177070", Reply::Written),
        (write(1, &[1]), ":011000010001ED", Reply::Written),
        (read(2, 1), ":0183017B", refused(1)),
        (read(0x20, 2), ":01030400050000F3", Reply::Registers(vec![5, 0])),
        (read(0x20, 17), ":01830379", refused(3)),
        (set(0x201, 600), ":01862257", refused(0x22)),
        (set(2, 60000), ":01862158", refused(0x21)),
        (read(0xFFF, 1), ":0183027A", refused(2)),
        (input, ":0184017A", refused(1)),
    ]
}

#[test]
fn replies_of_the_reference() {
    for (request, text, reply) in replies() {
        let used = text.len() + 2;
        let decoded = Decoded::Reply {
            used,
            reply: reply.clone(),
        };
        assert_eq!(decode_reply(&request, &line(text)), decoded, "{text}");
        assert_eq!(decode_reply(&request, &line(&text.to_lowercase())), decoded, "{text}");
        match reply {
            Reply::Exception(code) => {
                let mut pdu = Vec::new();
                encode_exception(request.pdu.function(), code, &mut pdu);
                assert_eq!(framed(1, &pdu), line(text));
                assert_eq!(used, 11, "reference/drives.md 5.2: an error reply has 11 characters");
            }
            reply => assert_eq!(replied(&request, &reply), line(text), "{text}"),
        }
    }
}

/// Lengths of reference/drives.md 5.2.
#[test]
fn lengths_of_the_reference() {
    for (request, asked, answered) in [
        (read(0, 1), 17, 15),
        (read(0, 16), 17, 75),
        (set(0, 0), 17, 17),
        (loop_test(), 17, 17),
        (write(0, &[0; 1]), 23, 17),
        (write(0, &[0; 16]), 83, 17),
    ] {
        assert_eq!(chars(request.pdu.encoded_len()), asked);
        assert_eq!(encoded(&request).len(), asked);
        assert_eq!(chars(request.pdu.reply_len()), answered);
    }
    assert_eq!(LONGEST, 513);
}

#[test]
fn every_cut_is_incomplete_and_what_follows_is_left() {
    for (request, text, reply) in replies() {
        let whole = line(text);
        for len in 0..whole.len() {
            assert_eq!(
                decode_reply(&request, &whole[..len]),
                Decoded::Incomplete,
                "{text} {len}"
            );
            assert_eq!(request_len(&whole[..len]), None);
        }
        let used = whole.len();
        let longer = [whole.as_slice(), b":01"].concat();
        assert_eq!(decode_reply(&request, &longer), Decoded::Reply { used, reply });
    }
}

#[test]
fn noise_before_a_colon_is_skipped_and_a_colon_begins_anew() {
    let request = read(2, 1);
    let reply = Reply::Registers(vec![6000]);
    for noise in [
        &b"\xFF"[..],
        b"0103",
        b":01",
        b":01030217",
        b"::::",
        b":\x80\xFF!",
        b"\r",
        b"\n",
        b"12\r\n",
        b"\n\n\xFF:0",
        &[0x55; 600],
    ] {
        let bytes = [noise, b":010302177073\r\n", b"\x01"].concat();
        assert_eq!(
            decode_reply(&request, &bytes),
            Decoded::Reply {
                used: noise.len() + 15,
                reply: reply.clone()
            },
            "{noise:?}"
        );
        assert_eq!(super::noise(&bytes), noise.len());
        assert_eq!(
            decode_reply(&request, &bytes[..noise.len() + 9]),
            Decoded::Incomplete,
            "{noise:?}"
        );
        assert_eq!(
            open_frame(&bytes[..noise.len() + 15]).map(|(address, _)| address),
            Some(1)
        );
    }
    assert_eq!(super::noise(b"12\n34"), 5);
}

#[test]
fn what_is_no_frame_says_why() {
    let request = read(2, 1);
    for (bytes, part) in [
        (&b":010302177074\r\n"[..], "LRC"),
        (b":01030217707\r\n", "odd number"),
        (b":0103021770733\r\n", "odd number"),
        (b":01030217G073\r\n", "not a hexadecimal digit"),
        (b":01030217 073\r\n", "not a hexadecimal digit"),
        (b":01030217G", "not a hexadecimal digit"),
        (b":01030217\xB0", "bit 7"),
        (b":0103021770\xB73\r\n", "bit 7"),
        (b":010302177073\n", "without a carriage return"),
        (b":010302177073\r\r\n", "without a line feed"),
        (b":010302177073\r0", "without a line feed"),
        (b":\r\n", "shorter"),
        (b":01FF\r\n", "shorter"),
        (b":\n", "without a carriage return"),
    ] {
        let text = String::from_utf8_lossy(bytes);
        let Decoded::Corrupt(why) = decode_reply(&request, bytes) else {
            panic!("{text:?} is not corrupt")
        };
        assert!(why.contains(part), "{text:?}: {why}");
        assert!(open_frame(bytes).is_none() && decode_request(bytes).is_none());
    }
    for noise in [b"0".repeat(LONGEST), [b":".to_vec(), b"0".repeat(LONGEST)].concat()] {
        let decoded = decode_reply(&request, &noise);
        assert!(
            matches!(decoded, Decoded::Corrupt(why) if why.contains("no end")),
            "{decoded:?}"
        );
        assert_eq!(decode_reply(&request, &noise[..LONGEST - 1]), Decoded::Incomplete);
    }
    let long = [b":".as_slice(), &b"0".repeat(LONGEST), b"\r\n"].concat();
    assert_eq!(
        decode_reply(&request, &long),
        Decoded::Corrupt("it is longer than any frame")
    );
}

#[test]
fn sound_frames_of_others_are_foreign() {
    let request = read(2, 1);
    for (address, pdu) in [
        (2, &[3, 2, 0x17, 0x70][..]),
        (0, &[3, 2, 0x17, 0x70]),
        (1, &[4, 2, 0x17, 0x70]),
        (1, &[3, 4, 0x17, 0x70, 0, 0]),
        (1, &[3, 2, 0x17]),
        (1, &[0x84, 2]),
        (1, &[3]),
    ] {
        let frame = framed(address, pdu);
        let bytes = [b"\xFF".as_slice(), &frame, b":01"].concat();
        assert_eq!(
            decode_reply(&request, &bytes),
            Decoded::Foreign { used: frame.len() + 1 },
            "{address} {pdu:?}"
        );
    }
}

#[test]
fn a_slave_refuses_what_it_cannot_read() {
    let refused = |pdu: &[u8]| decode_request(&framed(1, pdu)).unwrap().1.unwrap_err();
    assert_eq!(refused(&[7]), (7, Exception::FUNCTION));
    assert_eq!(refused(&[3, 0, 2, 0, 0]), (3, Exception::VALUE));
    // The byte count does not match the data.
    assert_eq!(refused(&[16, 0, 1, 0, 1, 4, 0, 1]), (16, Exception::VALUE));
}

fn requests() -> impl Strategy<Value = RequestPdu> {
    let words = |most| proptest::collection::vec(any::<u16>(), 1..=most);
    let table = prop_oneof![
        Just(Table::Coil),
        Just(Table::DiscreteInput),
        Just(Table::Input),
        Just(Table::Holding)
    ];
    prop_oneof![
        (table, 0u16..0xF000, 1u16..=2000).prop_map(|(table, start, count)| RequestPdu::Read {
            table,
            start,
            count: count.min(table.max_read()),
        }),
        (any::<u16>(), any::<bool>()).prop_map(|(address, on)| RequestPdu::WriteCoil { address, on }),
        (any::<u16>(), any::<u16>()).prop_map(|(address, value)| RequestPdu::WriteRegister { address, value }),
        (0u16..0xF000, proptest::collection::vec(any::<bool>(), 1..1968))
            .prop_map(|(start, bits)| RequestPdu::WriteCoils { start, bits }),
        (0u16..0xF000, words(123)).prop_map(|(start, values)| RequestPdu::WriteRegisters { start, values }),
        any::<[u16; 3]>().prop_map(|[address, and_mask, or_mask]| RequestPdu::MaskWrite {
            address,
            and_mask,
            or_mask
        }),
        (0u16..0xF000, 1u16..=125, 0u16..0xF000, words(121)).prop_map(
            |(read_start, read_count, write_start, values)| RequestPdu::ReadWrite {
                read_start,
                read_count,
                write_start,
                values,
            }
        ),
        any::<[u16; 2]>().prop_map(|[subfunction, data]| RequestPdu::Diagnostics { subfunction, data }),
        (1u8..=4, any::<u8>()).prop_map(|(code, object)| RequestPdu::DeviceIdentification { code, object }),
    ]
}

/// A regular reply to the request, with values from `seed`.
fn regular(pdu: &RequestPdu, seed: u16) -> Reply {
    let words = |count: u16| Reply::Registers((0..count).map(|i| seed.wrapping_mul(i | 1)).collect());
    match pdu {
        RequestPdu::Read { table, count, .. } if table.is_bits() => {
            Reply::Bits((0..*count).map(|i| seed >> (i % 16) & 1 == 1).collect())
        }
        RequestPdu::Read { count, .. } => words(*count),
        RequestPdu::ReadWrite { read_count, .. } => words(*read_count),
        RequestPdu::Diagnostics { .. } => Reply::Diagnostics(seed),
        RequestPdu::DeviceIdentification { code, .. } => {
            Reply::DeviceIdentification(vec![*code, 1, 0, 0, 1, 0, 2, b'N', seed as u8 & 0x7F])
        }
        _ => Reply::Written,
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1000))]

    #[test]
    fn any_characters_decode_to_something(
        pdu in requests(),
        bytes in proptest::collection::vec(
            prop_oneof![any::<u8>(), Just(b':'), Just(b'\r'), Just(b'\n'), b'0'..=b'9', b'A'..=b'F'], 0..600),
    ) {
        let request = to(1, pdu);
        let len = bytes.len();
        match decode_reply(&request, &bytes) {
            Decoded::Reply { used, .. } => {
                prop_assert!(used <= len);
                let (address, _) = open_frame(&bytes[..used]).unwrap();
                prop_assert_eq!(address, request.address);
            }
            Decoded::Foreign { used } => prop_assert!(used > 0 && used <= len && open_frame(&bytes[..used]).is_some()),
            Decoded::Incomplete | Decoded::Corrupt(_) => {}
        }
        let _ = (open_frame(&bytes), decode_request(&bytes), request_len(&bytes), noise(&bytes));
    }

    #[test]
    fn requests_come_back(pdu in requests(), address in 0u8..=247) {
        let frame = encoded(&to(address, pdu.clone()));
        prop_assert_eq!(frame.len(), chars(pdu.encoded_len()));
        prop_assert_eq!(decode_request(&frame), Some((address, Ok(pdu.clone()))));
        prop_assert_eq!(decode_request(&frame.to_ascii_lowercase()), Some((address, Ok(pdu))));
    }

    #[test]
    fn replies_come_back(
        pdu in requests(), address in 1u8..=247, seed: u16, code in 1u8..=255, exception: bool,
        cut in any::<prop::sample::Index>(),
    ) {
        let request = to(address, pdu);
        let reply = if exception { Reply::Exception(Exception::Modbus(code)) } else { regular(&request.pdu, seed) };
        let frame = replied(&request, &reply);
        let decoded = decode_reply(&request, &frame);
        if !matches!(request.pdu, RequestPdu::Diagnostics { .. }) || exception {
            prop_assert_eq!(&decoded, &Decoded::Reply { used: frame.len(), reply });
        }
        prop_assert_eq!(decode_reply(&request, &frame.to_ascii_lowercase()), decoded);
        prop_assert_eq!(decode_reply(&request, &frame[..cut.index(frame.len())]), Decoded::Incomplete);
    }

    /// A frame with one wrong character is never accepted; a letter in the other case is not an error.
    #[test]
    fn one_wrong_character_is_found(
        seed: u16, count in 1u16..=16, at in any::<prop::sample::Index>(), character: u8,
    ) {
        let request = read(0x20, count);
        let truth = replied(&request, &regular(&request.pdu, seed));
        let mut frame = truth.clone();
        let at = at.index(frame.len());
        frame[at] = character;
        if !frame.eq_ignore_ascii_case(&truth) {
            let decoded = decode_reply(&request, &frame);
            prop_assert!(matches!(decoded, Decoded::Corrupt(_) | Decoded::Incomplete), "{:?}", decoded);
        }
    }

    #[test]
    fn a_lost_or_doubled_character_is_found(
        seed: u16, count in 1u16..=16, at in any::<prop::sample::Index>(), doubled: bool,
    ) {
        let request = read(0x20, count);
        let truth = replied(&request, &regular(&request.pdu, seed));
        let mut frame = truth.clone();
        let at = at.index(frame.len() - 1);
        if doubled {
            frame.insert(at, frame[at]);
        } else {
            frame.remove(at);
        }
        let decoded = decode_reply(&request, &frame);
        // A doubled colon begins the frame a second time.
        let sound = matches!(decoded, Decoded::Reply { .. });
        prop_assert_eq!(sound, doubled && at == 0, "{:?}", decoded);
    }
}
