//! Bytes that no correct client sends lead to the right exception or a closed connection, without an effect on
//! other clients.

use proptest::prelude::*;
use proptest::test_runner::TestRunner;
use tokio::io::{AsyncReadExt, AsyncWriteExt};

use super::rig::{PATIENCE, Rig, frame, registers, until, words};

#[tokio::test]
async fn headers_that_close_the_connection() {
    let rig = Rig::new().await;
    for header in [
        &[0, 1, 0, 1, 0, 6, 1, 3, 0, 0, 0, 1][..], // protocol id 1
        &[0, 1, 0xFF, 0xFF, 0, 6, 1],              // protocol id 65535
        &[0, 1, 0, 0, 0, 0],                       // length 0
        &[0, 1, 0, 0, 0, 1, 1],                    // length 1: no function
        &[0, 1, 0, 0, 0, 255, 1, 3],               // length 255
        &[0, 1, 0, 0, 0xFF, 0xFF, 1, 3],           // length 65535
        b"GET /metrics HTTP/1.1\r\n\r\n",
        &[0x16, 3, 1, 2, 0, 1, 0, 1, 0xFC, 3, 3], // a TLS client
    ] {
        let mut client = rig.client().await;
        client.send(header).await;
        assert!(client.is_closed().await, "{header:?}");
    }
    until("all are gone", || rig.stats.modbus_tcp.connections() == 0).await;
    let mut client = rig.client().await;
    assert_eq!(client.ask(1, &words(3, &[2102, 1])).await, registers(3, &[5000]));
    rig.end().await;
}

#[tokio::test]
async fn what_came_before_a_bad_header_is_answered() {
    let rig = Rig::new().await;
    let mut client = rig.client().await;
    let mut bytes = frame(7, 1, &words(3, &[2102, 1]));
    bytes.extend_from_slice(&[0, 8, 0, 0, 0, 0]);
    client.send(&bytes).await;
    assert_eq!(client.answer().await, Some((7, 1, registers(3, &[5000]))));
    assert!(client.is_closed().await);
    rig.end().await;
}

/// Earlier requests are answered even if the bus takes its time, whatever follows the bad header.
#[tokio::test]
async fn a_write_before_a_bad_header_is_executed_and_answered() {
    let rig = Rig::new().await;
    rig.buses[0].pause(true);
    let mut client = rig.client().await;
    let write = words(6, &[0x8101, 5000]);
    let mut bytes = frame(7, 1, &write);
    bytes.extend_from_slice(&[0, 8, 0, 0, 0, 0]);
    bytes.extend_from_slice(&[0xAA; 3000]);
    client.send(&bytes).await;
    until("it waits for the bus", || rig.buses[0].waiting() == 1).await;
    client.send(&frame(9, 1, &write)).await;
    rig.buses[0].pause(false);
    assert_eq!(client.answer().await, Some((7, 1, write)));
    assert!(client.is_closed().await);
    assert_eq!(
        rig.buses[0].orders().len(),
        1,
        "nothing behind the bad header is executed"
    );
    until("it is gone", || rig.stats.modbus_tcp.connections() == 0).await;
    rig.end().await;
}

#[tokio::test]
async fn half_frames_and_silence_hold_nobody_up() {
    let rig = Rig::new().await;
    let mut idle = Vec::new();
    for cut in 0..12 {
        let mut client = rig.client().await;
        client.send(&frame(1, 1, &words(3, &[2102, 1]))[..cut]).await;
        idle.push((cut, client));
    }
    let mut other = rig.client().await;
    assert_eq!(other.ask(1, &words(3, &[2102, 1])).await, registers(3, &[5000]));
    // The rest of the requests arrives after all.
    for (cut, client) in &mut idle {
        client.send(&frame(1, 1, &words(3, &[2102, 1]))[*cut..]).await;
        assert_eq!(client.answer().await, Some((1, 1, registers(3, &[5000]))));
    }
    rig.end().await;
}

#[tokio::test]
async fn a_client_that_does_not_read_holds_nobody_up() {
    let rig = Rig::new().await;
    let mut deaf = rig.client().await;
    let batch: Vec<u8> = (0..1000u16)
        .flat_map(|t| frame(t, 1, &words(3, &[0x8000, 19])))
        .collect();
    // The client sends until both sockets are full: the server has then stopped reading.
    while tokio::time::timeout(std::time::Duration::from_millis(300), deaf.stream.write_all(&batch))
        .await
        .is_ok()
    {}
    let mut other = rig.client().await;
    for _ in 0..100 {
        assert_eq!(other.ask(1, &words(3, &[2102, 1])).await, registers(3, &[5000]));
    }
    drop(deaf);
    until("the deaf one is gone", || rig.stats.modbus_tcp.connections() == 1).await;
    rig.end().await;
}

#[tokio::test]
async fn a_long_pipelined_batch() {
    let rig = Rig::new().await;
    let client = rig.client().await;
    let (mut reader, mut writer) = client.stream.into_split();
    let count = 20_000u16;
    let sender = tokio::spawn(async move {
        let batch: Vec<u8> = (0..count).flat_map(|t| frame(t, 1, &words(3, &[2100, 11]))).collect();
        writer.write_all(&batch).await.unwrap();
        writer
    });
    for t in 0..count {
        let mut answer = [0; 31];
        tokio::time::timeout(PATIENCE, reader.read_exact(&mut answer))
            .await
            .unwrap()
            .unwrap();
        assert_eq!(answer[..2], t.to_be_bytes(), "cached answers keep their order");
    }
    sender.await.unwrap();
    rig.end().await;
}

/// Random bytes, random frames and random PDUs for known functions: every frame is answered once with its own
/// transaction id, unit id and function, or the connection is closed; the server continues to serve.
#[test]
fn garbage() {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .unwrap();
    let rig = runtime.block_on(Rig::new());
    let pdu = prop_oneof![
        prop::collection::vec(any::<u8>(), 1..254),
        (
            prop::sample::select(vec![1u8, 2, 3, 4, 5, 6, 15, 16, 22, 23, 43]),
            prop::collection::vec(any::<u8>(), 0..20)
        )
            .prop_map(|(function, rest)| [vec![function], rest].concat()),
        (
            prop::sample::select(vec![3u8, 4, 6, 16]),
            prop::sample::select(vec![
                0u16, 7, 100, 500, 2000, 2100, 0x7FFF, 0x8000, 0x8100, 0x8200, 0xFFFF
            ]),
            any::<[u16; 3]>()
        )
            .prop_map(|(function, start, rest)| words(function, &[start, rest[0] % 130, rest[1] % 9, rest[2]])),
    ];
    let frames = prop::collection::vec(
        (any::<u16>(), prop::sample::select(vec![0u8, 1, 2, 3, 4, 9, 255]), pdu),
        1..40,
    );
    let garbage = prop::collection::vec(any::<u8>(), 0..300);
    let mut runner = TestRunner::new(ProptestConfig {
        cases: 200,
        failure_persistence: None,
        ..ProptestConfig::default()
    });
    runner
        .run(&(frames, garbage), |(frames, garbage)| {
            runtime.block_on(async {
                let mut client = rig.client().await;
                let batch: Vec<u8> = frames.iter().flat_map(|(t, unit, pdu)| frame(*t, *unit, pdu)).collect();
                client.send(&batch).await;
                let mut wanted: Vec<(u16, u8, u8)> = frames.iter().map(|(t, unit, pdu)| (*t, *unit, pdu[0])).collect();
                for _ in &frames {
                    let (t, unit, pdu) = client.answer().await.expect("the connection was closed");
                    let place = wanted
                        .iter()
                        .position(|w| (w.0, w.1) == (t, unit) && (w.2 | 0x80 == pdu[0] || w.2 == pdu[0]))
                        .expect("an answer to nothing");
                    wanted.swap_remove(place);
                }
                // Arbitrary bytes may end the connection, and must have no other effect.
                let _ = client.stream.write_all(&garbage).await;
                let _ = client.stream.shutdown().await;
                let mut rest = Vec::new();
                let _ = tokio::time::timeout(PATIENCE, client.stream.read_to_end(&mut rest))
                    .await
                    .unwrap();
            });
            Ok(())
        })
        .unwrap();
    runtime.block_on(async {
        until("all are gone", || rig.stats.modbus_tcp.connections() == 0).await;
        rig.end().await;
    });
}
