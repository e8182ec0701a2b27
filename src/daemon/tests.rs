use super::*;
use crate::event::EventKind;

/// A gateway with so many buses, none of which has its adapter.
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
    settings.keeps_history = false;
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
