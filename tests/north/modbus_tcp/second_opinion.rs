//! tokio-modbus as a second opinion on frames: requests that it encodes are answered with their meaning, it can
//! decode the answers, and what it cannot decode is refused here.

use std::sync::Arc;
use std::time::Instant;

use arc_swap::ArcSwap;
use drivegate_core::order::Authority;
use drivegate_north::modbus_tcp::{Loopback, Uncached};
use drivegate_proto::RequestPdu;
use drivegate_proto::Table;
use proptest::prelude::*;
use tokio_modbus::{Request, Response};

use super::rig::{frame, options, plant};

/// Any request that a client of tokio-modbus can send, with a number of items that fits into a frame.
fn request() -> impl Strategy<Value = Request<'static>> {
    let (address, count) = (any::<u16>(), 0u16..=300);
    let span = (address, count);
    let words = |most| prop::collection::vec(any::<u16>(), 1..=most);
    prop_oneof![
        span.clone().prop_map(|(a, n)| Request::ReadCoils(a, n)),
        span.clone().prop_map(|(a, n)| Request::ReadDiscreteInputs(a, n)),
        span.clone().prop_map(|(a, n)| Request::ReadHoldingRegisters(a, n)),
        span.prop_map(|(a, n)| Request::ReadInputRegisters(a, n)),
        (any::<u16>(), any::<bool>()).prop_map(|(a, on)| Request::WriteSingleCoil(a, on)),
        (any::<u16>(), any::<u16>()).prop_map(|(a, value)| Request::WriteSingleRegister(a, value)),
        (any::<u16>(), prop::collection::vec(any::<bool>(), 1..=1968))
            .prop_map(|(a, bits)| Request::WriteMultipleCoils(a, bits.into())),
        (any::<u16>(), words(123)).prop_map(|(a, values)| Request::WriteMultipleRegisters(a, values.into())),
        any::<(u16, u16, u16)>().prop_map(|(a, and, or)| Request::MaskWriteRegister(a, and, or)),
        (any::<u16>(), 1u16..=125, any::<u16>(), words(121))
            .prop_map(|(read, n, a, values)| Request::ReadWriteMultipleRegisters(read, n, a, values.into())),
    ]
}

/// The PDU that tokio-modbus creates for the request: its client writes it into a pipe.
fn encoded(request: Request<'static>) -> Vec<u8> {
    use tokio::io::AsyncReadExt;
    use tokio_modbus::client::Client;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(async {
        let (near, mut far) = tokio::io::duplex(1024);
        let mut client = tokio_modbus::client::tcp::attach_slave(near, tokio_modbus::slave::Slave(1));
        let call = client.call(request);
        let read = async {
            let mut header = [0; 7];
            far.read_exact(&mut header).await.unwrap();
            let mut pdu = vec![0; usize::from(u16::from_be_bytes([header[4], header[5]])) - 1];
            far.read_exact(&mut pdu).await.unwrap();
            pdu
        };
        tokio::select! {
            pdu = read => pdu,
            _ = call => unreachable!("nobody has answered"),
        }
    })
}

/// Translates the request of the other library to the types of this program.
fn meant(request: &Request<'static>) -> Option<RequestPdu> {
    let read = |table: Table, start: u16, count: u16| {
        let fits = (1..=table.max_read()).contains(&count) && u32::from(start) + u32::from(count) <= 65_536;
        fits.then_some(RequestPdu::read(table, start, count))
    };
    let fits = |start: u16, count: usize| usize::from(start) + count <= 65_536;
    match request {
        Request::ReadCoils(a, n) => read(Table::Coil, *a, *n),
        Request::ReadDiscreteInputs(a, n) => read(Table::DiscreteInput, *a, *n),
        Request::ReadHoldingRegisters(a, n) => read(Table::Holding, *a, *n),
        Request::ReadInputRegisters(a, n) => read(Table::Input, *a, *n),
        Request::WriteSingleCoil(address, on) => Some(RequestPdu::WriteCoil {
            address: *address,
            on: *on,
        }),
        Request::WriteSingleRegister(address, value) => Some(RequestPdu::write_register(*address, *value)),
        Request::WriteMultipleCoils(start, bits) => fits(*start, bits.len()).then(|| RequestPdu::WriteCoils {
            start: *start,
            bits: bits.to_vec(),
        }),
        Request::WriteMultipleRegisters(start, values) => {
            fits(*start, values.len()).then(|| RequestPdu::WriteRegisters {
                start: *start,
                values: values.to_vec(),
            })
        }
        Request::MaskWriteRegister(address, and_mask, or_mask) => Some(RequestPdu::MaskWrite {
            address: *address,
            and_mask: *and_mask,
            or_mask: *or_mask,
        }),
        Request::ReadWriteMultipleRegisters(read_start, read_count, write_start, values) => {
            let fits = fits(*read_start, usize::from(*read_count)) && fits(*write_start, values.len());
            fits.then(|| RequestPdu::ReadWrite {
                read_start: *read_start,
                read_count: *read_count,
                write_start: *write_start,
                values: values.to_vec(),
            })
        }
        _ => None,
    }
}

/// Whether tokio-modbus takes a reply as one to a request with that function.
fn understood(pdu: &[u8]) -> bool {
    match Response::try_from(bytes::Bytes::copy_from_slice(pdu)) {
        Ok(response) => response.function_code().value() == pdu[0],
        // An exception is not decoded as a response by the library.
        Err(_) => pdu.len() == 2 && pdu[0] & 0x80 != 0,
    }
}

/// The answers to one PDU, without sockets.
fn answer(pdu: &[u8]) -> Vec<u8> {
    let mut options = options();
    options.uncached = Uncached::Refuse;
    let plant = Arc::new(ArcSwap::from_pointee(plant()));
    let mut client = Loopback::new(
        options,
        plant,
        Arc::default(),
        ([127, 0, 0, 1], 502).into(),
        Authority::ReadOnly,
    );
    let answer = client.receive(&frame(7, 1, pdu), Instant::now());
    assert_eq!(answer[..4], [0, 7, 0, 0]);
    answer[7..].to_vec()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn its_requests_mean_the_same_here(request in request()) {
        let pdu = encoded(request.clone());
        prop_assert_eq!(RequestPdu::decode(&pdu).ok(), meant(&request));
        prop_assert!(understood(&answer(&pdu)));
    }

    /// A byte is changed, cut off or added: both libraries decode equal requests, or this one refuses. (The other
    /// one accepts some that the specification forbids, such as a quantity of 0.)
    #[test]
    fn mutated_requests_are_never_taken_for_more(request in request(), place: prop::sample::Index, byte: u8, how in 0..3) {
        let mut pdu = encoded(request);
        match how {
            0 => *place.get_mut(&mut pdu) = byte,
            1 => pdu.truncate(place.index(pdu.len()).max(1)),
            _ if pdu.len() < 253 => pdu.push(byte),
            _ => {}
        }
        if let Ok(own) = RequestPdu::decode(&pdu)
            && !matches!(own, RequestPdu::Diagnostics { .. } | RequestPdu::DeviceIdentification { .. })
        {
            // tokio-modbus panics on some requests that are refused here (its issue 298), so it decodes only accepted ones.
            let other = Request::try_from(bytes::Bytes::from(pdu.clone()));
            prop_assert_eq!(other.ok().and_then(|other| meant(&other)), Some(own));
        }
        prop_assert!(understood(&answer(&pdu)));
    }
}
