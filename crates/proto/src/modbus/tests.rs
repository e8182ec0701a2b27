use super::*;
use proptest::prelude::*;

#[test]
fn refused_requests() {
    assert_eq!(RequestPdu::decode(&[]), Err(Exception::FUNCTION));
    assert_eq!(RequestPdu::decode(&[0x41]), Err(Exception::FUNCTION));
    assert_eq!(
        RequestPdu::decode(&[3, 0, 0, 0, 0]),
        Err(Exception::VALUE),
        "quantity 0"
    );
    assert_eq!(
        RequestPdu::decode(&[3, 0, 0, 0, 126]),
        Err(Exception::VALUE),
        "126 registers"
    );
    assert_eq!(
        RequestPdu::decode(&[3, 0xFF, 0xFF, 0, 2]),
        Err(Exception::ADDRESS),
        "past the end"
    );
    assert_eq!(RequestPdu::decode(&[3, 0, 0, 0]), Err(Exception::VALUE), "short");
    assert_eq!(
        RequestPdu::decode(&[5, 0, 0, 1, 0]),
        Err(Exception::VALUE),
        "coil value"
    );
    assert_eq!(
        RequestPdu::decode(&[16, 0, 0, 0, 1, 3, 0, 0, 0]),
        Err(Exception::VALUE),
        "odd byte count"
    );
    assert_eq!(
        RequestPdu::decode(&[15, 0, 0, 0, 100, 1, 0]),
        Err(Exception::VALUE),
        "100 coils in one byte"
    );
    assert_eq!(RequestPdu::decode(&[43, 13, 1, 0]), Err(Exception::FUNCTION));
}

#[test]
fn a_refusal_with_00_is_the_lines_and_no_answer() {
    let read = RequestPdu::read(Table::Holding, 0x20, 1);
    assert_eq!(Reply::decode(&read, &[0x83, 0]), Err(Misfit));
    assert_eq!(
        Reply::decode(&read, &[0x83, 1]),
        Ok(Reply::Exception(Exception::Modbus(1)))
    );
}

fn any_request() -> impl Strategy<Value = RequestPdu> {
    let table = prop_oneof![
        Just(Table::Coil),
        Just(Table::DiscreteInput),
        Just(Table::Input),
        Just(Table::Holding)
    ];
    prop_oneof![
        (table, 0u16..60_000, 1u16..=125).prop_map(|(table, start, count)| RequestPdu::Read { table, start, count }),
        (any::<u16>(), any::<bool>()).prop_map(|(address, on)| RequestPdu::WriteCoil { address, on }),
        (any::<u16>(), any::<u16>()).prop_map(|(address, value)| RequestPdu::WriteRegister { address, value }),
        (0u16..60_000, prop::collection::vec(any::<bool>(), 1..1968))
            .prop_map(|(start, bits)| RequestPdu::WriteCoils { start, bits }),
        (0u16..60_000, prop::collection::vec(any::<u16>(), 1..=123))
            .prop_map(|(start, values)| RequestPdu::WriteRegisters { start, values }),
        (any::<u16>(), any::<u16>(), any::<u16>()).prop_map(|(address, and_mask, or_mask)| RequestPdu::MaskWrite {
            address,
            and_mask,
            or_mask
        }),
        (
            0u16..60_000,
            1u16..=125,
            0u16..60_000,
            prop::collection::vec(any::<u16>(), 1..=121)
        )
            .prop_map(|(read_start, read_count, write_start, values)| RequestPdu::ReadWrite {
                read_start,
                read_count,
                write_start,
                values
            }),
        (any::<u16>(), any::<u16>()).prop_map(|(subfunction, data)| RequestPdu::Diagnostics { subfunction, data }),
        (any::<u8>(), any::<u8>()).prop_map(|(code, object)| RequestPdu::DeviceIdentification { code, object }),
    ]
}

fn regular_reply(request: &RequestPdu) -> Reply {
    match request {
        RequestPdu::Read { table, count, .. } if table.is_bits() => {
            Reply::Bits((0..*count).map(|i| i % 3 == 0).collect())
        }
        RequestPdu::Read { count, .. } | RequestPdu::ReadWrite { read_count: count, .. } => {
            Reply::Registers((0..*count).collect())
        }
        RequestPdu::Diagnostics { .. } => Reply::Diagnostics(7),
        RequestPdu::DeviceIdentification { .. } => Reply::DeviceIdentification(vec![1, 1, 0, 0, 0]),
        _ => Reply::Written,
    }
}

proptest! {
    #[test]
    fn requests_and_replies_survive_the_round_trip(request in any_request()) {
        let mut bytes = Vec::new();
        request.encode(&mut bytes);
        prop_assert_eq!(bytes.len(), request.encoded_len());
        prop_assert!(bytes.len() <= MAX_PDU);
        prop_assert_eq!(RequestPdu::decode(&bytes), Ok(request.clone()));

        let reply = regular_reply(&request);
        let mut bytes = Vec::new();
        reply.encode(&request, &mut bytes);
        prop_assert_eq!(bytes.len(), request.reply_len());
        prop_assert_eq!(Reply::decode(&request, &bytes), Ok(reply));
    }

    #[test]
    fn no_bytes_panic(bytes in prop::collection::vec(any::<u8>(), 0..300), request in any_request()) {
        let _ = RequestPdu::decode(&bytes);
        let _ = Reply::decode(&request, &bytes);
    }
}
