//! Other views of a listener: a drive at units 0 and 255, the common model at 0, only the drive's registers; and
//! function 23, which writes and reads.

use drivegate_core::order::{Order, Outcome};
use drivegate_model::drive::Value;
use drivegate_north::modbus_tcp::{Options, Registers, View};
use drivegate_proto::RequestPdu;

use super::rig::{Rig, listener, options, registers, words, write};

fn showing(view: View) -> Options {
    let mut listener = listener();
    listener.view = view;
    Options {
        listeners: vec![listener],
        ..options()
    }
}

/// The request of function 23.
pub(super) fn write_and_read((start, values): (u16, &[u16]), (read, count): (u16, u16)) -> Vec<u8> {
    let mut pdu = Vec::new();
    let values = values.to_vec();
    let request = RequestPdu::ReadWrite {
        read_start: read,
        read_count: count,
        write_start: start,
        values,
    };
    request.encode(&mut pdu);
    pdu
}

fn points(rig: &Rig) -> Vec<Vec<(String, Value)>> {
    let profile = rig.drive("pump-1").spec.profile.clone();
    let named = |order: Order| match order {
        Order::Points(values) => values
            .iter()
            .map(|(index, value)| (profile.points.get(*index).unwrap().name.clone(), *value))
            .collect(),
        other => panic!("{other:?}"),
    };
    rig.buses[0].orders().into_iter().map(named).collect()
}

fn stop() -> Vec<(String, Value)> {
    vec![("run".to_string(), Value::Bool(false))]
}

#[tokio::test]
async fn a_drive_at_units_0_and_255_is_stopped_by_what_stops_all_elsewhere() {
    for registers_at in [Registers::Model, Registers::ModelAtZero, Registers::Raw] {
        let view = View {
            default_drive: Some("pump-1".to_string()),
            registers: registers_at,
            ..View::default()
        };
        let rig = Rig::with(showing(view)).await;
        let mut client = rig.client().await;
        for unit in [0, 255] {
            let alone = words(6, &[0x0100, 1]);
            assert_eq!(client.ask(unit, &alone).await, alone, "{registers_at:?}");
            assert_eq!(points(&rig), [stop()], "{registers_at:?}");
            let more = write(0x00FF, &[7, 1, 7]);
            assert_eq!(client.ask(unit, &more).await, [0x90, 2]);
            assert_eq!(points(&rig), [stop()], "{registers_at:?}: whatever else is written");
            let both = write_and_read((0x0100, &[1]), (0x8000, 1));
            client.ask(unit, &both).await;
            assert_eq!(points(&rig), [stop()], "{registers_at:?}: by function 23");
        }
        rig.end().await;
    }
}

#[tokio::test]
async fn a_default_drive_is_read_and_commanded_like_its_own_unit() {
    let view = View {
        default_drive: Some("pump-1".to_string()),
        ..View::default()
    };
    let mut rig = Rig::with(showing(view)).await;
    let mut client = rig.client().await;
    let own = client.ask(1, &words(4, &[0x8000, 10])).await;
    for unit in [0, 255] {
        assert_eq!(
            client.ask(unit, &words(4, &[0x8000, 2])).await[..4],
            own[..1]
                .iter()
                .chain(&[4])
                .chain(&own[2..4])
                .copied()
                .collect::<Vec<u8>>()[..]
        );
        assert_eq!(client.ask(unit, &words(6, &[0x8101, 1000])).await[0], 6);
        assert_eq!(
            points(&rig),
            [vec![("speed_reference".to_string(), Value::Number(10.0))]]
        );
    }
    // Without a default drive, both units behave as before.
    rig.reload(showing(View::default())).await.unwrap();
    assert_eq!(client.ask(0, &words(4, &[0x8000, 1])).await, [0x84, 0x0A]);
    assert_eq!(client.ask(255, &words(6, &[0x8101, 1000])).await, [0x86, 1]);
    rig.end().await;
}

#[tokio::test]
async fn the_common_model_at_0_is_the_one_at_0x8000() {
    let view = View {
        registers: Registers::ModelAtZero,
        ..View::default()
    };
    let (plain, rig) = (Rig::new().await, Rig::with(showing(view)).await);
    let (mut usual, mut client) = (plain.client().await, rig.client().await);
    for (here, there, count) in [(0x0003, 0x8003, 16), (0x0110, 0x8100, 3), (0x0200, 0x8200, 26)] {
        let expected = usual.ask(1, &words(3, &[there, count])).await;
        assert_eq!(client.ask(1, &words(3, &[here, count])).await, expected, "{here:#x}");
    }
    // The drive's own registers appear from 0x0300 on, and there is nothing in between.
    let own = client.ask(1, &words(3, &[2100, 1])).await;
    assert_eq!(own, usual.ask(1, &words(3, &[2100, 1])).await);
    for nowhere in [0x0100, 0x010F, 0x00FF, 0x8000] {
        assert_eq!(client.ask(1, &words(3, &[nowhere, 2])).await, [0x83, 2], "{nowhere:#x}");
    }
    let echoed = words(6, &[0x0110, 0]);
    assert_eq!(client.ask(1, &echoed).await, echoed);
    let both = [stop()[0].clone(), ("reverse".to_string(), Value::Bool(false))];
    assert_eq!(points(&rig), [both.to_vec()]);
    // A stop within a block that begins where no register is.
    assert_eq!(client.ask(1, &write(0x010F, &[0, 0])).await, [0x90, 2]);
    assert_eq!(points(&rig), [both.to_vec()]);
    assert_eq!(
        client.ask(1, &words(6, &[0x0100, 1])).await,
        [0x86, 2],
        "no unit is the gateway"
    );
    assert!(points(&rig).is_empty());
    plain.end().await;
    rig.end().await;
}

#[tokio::test]
async fn registers_of_the_drive_alone_are_there_up_to_the_last() {
    let view = View {
        registers: Registers::Raw,
        ..View::default()
    };
    let rig = Rig::with(showing(view)).await;
    let mut client = rig.client().await;
    assert_eq!(
        client.ask(1, &words(3, &[0xFA00, 2])).await,
        registers(3, &[0xFA00, 0xFA01])
    );
    assert_eq!(
        rig.buses[0].orders(),
        [Order::Read(RequestPdu::read(
            drivegate_proto::Table::Holding,
            0xFA00,
            2
        ))]
    );
    // Address 2000 is the control word of the drive, so a stop written to it is treated as a stop.
    assert_eq!(client.ask(1, &words(6, &[2000, 0])).await[0], 6);
    assert_eq!(
        rig.buses[0].orders(),
        [Order::Write(RequestPdu::write_register(2000, 0))]
    );
    assert_eq!(
        client.ask(1, &words(6, &[0x8100, 1])).await[0],
        0x86,
        "there is no common model"
    );
    assert!(rig.buses[0].orders().is_empty());
    rig.end().await;
}

#[tokio::test]
async fn function_23_writes_and_reads_behind_the_answer() {
    let rig = Rig::new().await;
    let mut client = rig.client().await;
    let status = client.ask(1, &words(3, &[0x8000, 2])).await;
    let mut expected = status.clone();
    expected[0] = 23;
    let answer = client.ask(1, &write_and_read((0x8101, &[2000]), (0x8000, 2))).await;
    assert_eq!(answer, expected);
    let reference = vec![("speed_reference".to_string(), Value::Number(20.0))];
    assert_eq!(points(&rig), std::slice::from_ref(&reference));
    // Registers that are not polled are read from the drive, after the write.
    let answer = client.ask(1, &write_and_read((0x8101, &[2000]), (300, 2))).await;
    assert_eq!(answer, registers(23, &[300, 301]));
    let orders = rig.buses[0].orders();
    assert!(matches!(orders[..], [Order::Points(_), Order::Read(_)]), "{orders:?}");
    // Neither part is executed if the read is invalid, nor is the read if the write failed.
    assert_eq!(
        client.ask(1, &write_and_read((0x8101, &[2000]), (0x8300, 2))).await,
        [0x97, 2]
    );
    assert!(rig.buses[0].orders().is_empty());
    rig.buses[0].answers(|_| Some(Outcome::TimedOut));
    assert_eq!(
        client.ask(1, &write_and_read((0x8101, &[2000]), (0x8000, 2))).await,
        [0x97, 0x0B]
    );
    assert_eq!(rig.buses[0].orders().len(), 1);
    rig.buses[0].answers(|command| Some(super::rig::acknowledge(command)));
    // A stop is carried out whatever the read part is.
    assert_eq!(
        client.ask(1, &write_and_read((0x8100, &[0]), (0x8300, 2))).await,
        [0x97, 2]
    );
    let both = vec![stop()[0].clone(), ("reverse".to_string(), Value::Bool(false))];
    assert_eq!(points(&rig), [both]);
    // A heartbeat is not a command, and is answered with the values that are read.
    assert_eq!(
        client.ask(1, &write_and_read((0x8103, &[1]), (0x8000, 2))).await,
        expected
    );
    assert!(rig.buses[0].orders().is_empty());
    rig.end().await;
}

#[tokio::test]
async fn function_23_is_unknown_to_who_may_not_write() {
    let mut options = options();
    options.listeners[0].write.clear();
    let rig = Rig::with(options).await;
    let mut client = rig.client().await;
    let unit_2 = rig.drive("pump-2").spec.unit;
    for unit in [1, unit_2] {
        assert_eq!(
            client.ask(unit, &write_and_read((0x8101, &[2000]), (0x8000, 2))).await,
            [0x97, 1]
        );
    }
    assert!(rig.buses[0].orders().is_empty());
    rig.end().await;
}
