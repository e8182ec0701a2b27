use futures_util::FutureExt as _;

use drivegate_testkit::mqtt as packets;
use drivegate_testkit::online;

use super::*;
use drivegate_core::event::EventKind;
use drivegate_core::order::{Authority, Order, Origin, SourceKind};
use drivegate_core::plant::OrderRequest;
use drivegate_model::drive::{ModelPoint, Value};

/// A gateway with this number of buses, none of which has an adapter.
fn without_adapters(buses: usize) -> Settings {
    let bus = |n| {
        format!(
            "[[bus]]\nname = \"line{n}\"\nport = \"/dev/drivegate-missing-{n}\"\n\
             [[bus.drive]]\nname = \"p{n}\"\naddress = 1\nprofile = \"vacon-nx\"\n"
        )
    };
    let text = std::iter::once("[gateway]\nname = \"hall\"\n".to_string())
        .chain((0..buses).map(bus))
        .collect::<String>();
    let loaded = Settings::parse("drivegate.toml", &text, std::iter::empty());
    let mut settings = loaded.settings.unwrap_or_else(|| panic!("{:?}", loaded.errors));
    settings.socket = local::SocketPath::Off;
    settings.recordings.max_count = 0;
    settings.state_files = crate::config::StateFiles::Unused;
    settings
}

#[tokio::test(flavor = "multi_thread")]
async fn whoever_hears_of_a_bus_finds_it_in_the_plant() {
    const NEW: usize = 31;
    let mut daemon = Daemon::start(without_adapters(1)).await.unwrap();
    let plant = daemon.plant();
    let mut events = plant.load().events.subscribe();
    let listener = std::thread::spawn(move || {
        let down = std::iter::from_fn(|| events.blocking_recv().ok())
            .filter(|event| event.kind == EventKind::BusDown && event.bus != "line0");
        let unknown = |bus: &str| !plant.load().buses.iter().any(|b| b.image.spec.name == bus);
        down.take(NEW)
            .filter(|event| unknown(&event.bus))
            .map(|event| event.bus.clone())
            .collect::<Vec<_>>()
    });
    daemon.reload(without_adapters(1 + NEW)).await.unwrap();
    assert_eq!(listener.join().unwrap(), Vec::<String>::new());
    daemon.stop().await;
}

/// A broker that answers CONNECT and SUBSCRIBE; returns the first packet whose topic contains `wanted`.
fn first_packet(listener: &std::net::TcpListener, wanted: &'static str) -> std::thread::JoinHandle<Vec<u8>> {
    let listener = listener.try_clone().unwrap();
    std::thread::spawn(move || {
        let (sender, found) = std::sync::mpsc::channel();
        // The broker gets two connections: plain client and edge node.
        for stream in listener.incoming().take(2).map_while(Result::ok) {
            let sender = sender.clone();
            std::thread::spawn(move || {
                let mut stream = stream;
                while let Some((kind, body)) = packets::read_packet(&mut stream) {
                    let answer = match kind >> 4 {
                        1 => vec![0x20, 3, 0, 0, 0],
                        8 => {
                            let codes = vec![1; packets::filters(&body).len()];
                            let answer = packets::subscribed(&body, &codes);
                            [&[0x90, u8::try_from(answer.len()).unwrap()][..], &answer].concat()
                        }
                        3 if body.windows(wanted.len()).any(|part| part == wanted.as_bytes()) => {
                            let _ = sender.send(body);
                            continue;
                        }
                        _ => continue,
                    };
                    std::io::Write::write_all(&mut stream, &answer).unwrap();
                }
            });
        }
        found.recv_timeout(std::time::Duration::from_secs(60)).unwrap()
    })
}

#[tokio::test(flavor = "multi_thread")]
async fn the_first_birth_of_the_node_names_its_buses() {
    // The birth message may be a few milliseconds before or after the start of the buses, so several attempts are made.
    for _ in 0..6 {
        let (state, listener) = (
            tempfile::tempdir().unwrap(),
            std::net::TcpListener::bind("127.0.0.1:0").unwrap(),
        );
        let birth = first_packet(&listener, "/NBIRTH/");
        let mut settings = without_adapters(3);
        let text = format!(
            "[gateway]\nname = \"hall\"\nstate_dir = {:?}\n[mqtt]\nurl = \"mqtt://{}\"\n[mqtt.sparkplug]\ngroup = \"plant\"\n\
             [[bus]]\nname = \"b\"\nport = \"/dev/null\"\n[[bus.drive]]\nname = \"d\"\naddress = 1\nprofile = \"vacon-nx\"\n",
            state.path(),
            listener.local_addr().unwrap()
        );
        let loaded = Settings::parse("drivegate.toml", &text, std::iter::empty());
        settings.mqtt = loaded.settings.unwrap_or_else(|| panic!("{:?}", loaded.errors)).mqtt;
        let daemon = Daemon::start(settings).await.unwrap();
        let birth = tokio::task::spawn_blocking(|| birth.join().unwrap()).await.unwrap();
        for bus in ["Bus/line0/state", "Bus/line2/queue"] {
            assert!(birth.windows(bus.len()).any(|part| part == bus.as_bytes()), "no {bus}");
        }
        daemon.stop().await;
    }
}

/// On the single thread of this test no server can end during the first poll of the shutdown: whatever waits for one is not
/// done by then.
#[tokio::test]
async fn the_stops_at_the_end_wait_for_no_server() {
    let line = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let text = format!(
        "[gateway]\nname = \"hall\"\n[modbus_tcp]\nlisten = [\"127.0.0.1:0\"]\n[[bus]]\nname = \"line\"\nport = \"tcp://{}\"\n\
         response_timeout = \"10s\"\n[[bus.drive]]\nname = \"pump\"\naddress = 1\nprofile = \"vacon-nx\"\naccess = \"control\"\n",
        line.local_addr().unwrap()
    );
    let loaded = Settings::parse("drivegate.toml", &text, std::iter::empty());
    let mut settings = without_adapters(0);
    let configured = loaded.settings.unwrap_or_else(|| panic!("{:?}", loaded.errors));
    (settings.buses, settings.modbus_tcp) = (configured.buses, configured.modbus_tcp);
    let daemon = Daemon::start(settings).await.unwrap();
    // The first poll is on the line and stays unanswered, so the order waits.
    let mut adapter = line.accept().unwrap().0;
    std::io::Read::read_exact(&mut adapter, &mut [0; 8]).unwrap();
    let drive = daemon.plant().load().drive("pump").unwrap();
    online(&drive.image);
    let run = drive.image.spec.profile.model_index(ModelPoint::Run).unwrap();
    let order = Order::Points(vec![(run, Value::Bool(true))]);
    let request = OrderRequest::new(order, Origin::new(SourceKind::ModbusTcp, "plc"), Authority::Write);
    let mut placed = drive.place(request.within(Duration::from_secs(60)), Instant::now());
    let early = placed.answered().now_or_never();
    assert!(early.is_none(), "{early:?}");
    let mut end = Box::pin(daemon.stop());
    assert!(end.as_mut().now_or_never().is_none(), "the server is still ending");
    let answer = placed.answered().now_or_never();
    assert!(
        matches!(&answer, Some(answer) if answer.outcome == Outcome::ShuttingDown),
        "{answer:?}"
    );
    end.await;
}
