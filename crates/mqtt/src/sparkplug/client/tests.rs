use arc_swap::ArcSwap;

use super::super::wire::Metric;
use super::*;
use crate::fixture;
use drivegate_core::order::Order;
use drivegate_model::drive::{ModelPoint, Value};
use drivegate_testkit::take_next;

/// A node without a connection, on the drives `p1` and `p2`.
async fn node(state_dir: &std::path::Path) -> NodeClient {
    let plant = fixture::plant(&["p1", "p2"]);
    for drive in ["p1", "p2"] {
        fixture::read(&plant, drive, 1, 0, Instant::now());
    }
    let stats = Arc::<NorthState>::default();
    let options = Options {
        group: "plant".to_string(),
        node: "hall".to_string(),
        primary_host: String::new(),
        alias: true,
        history: true,
        state_dir: state_dir.to_path_buf(),
    };
    let bd_seq = BdSeq::open(state_dir, &stats.patience).await;
    let broker = (
        crate::client::tests::options(None),
        Right::lasting(),
        ClientLeft::default(),
    );
    NodeClient::new(options, broker, bd_seq, Arc::new(ArcSwap::from_pointee(plant)), stats)
}

/// A command for `p1`.
fn run(state: bool) -> Incoming {
    let metric = Metric {
        name: Some("run".to_string()),
        value: Some(MetricValue::Boolean(state)),
        ..Metric::default()
    };
    let payload = Payload {
        timestamp: Some(u64::from(state)),
        metrics: vec![metric],
        seq: None,
    };
    Incoming {
        topic: "spBv1.0/plant/DCMD/hall/p1".to_string(),
        payload: payload.encoded(),
        ..Incoming::default()
    }
}

/// Place and order of the next command on the bus.
fn ordered(plant: &Plant) -> Option<(usize, Order)> {
    let command = take_next(&plant.buses[0].queue, Instant::now())?;
    Some((command.drive()?.place(), command.intent.order.clone()))
}

/// A client that ends with a reload receives commands until its last message is sent.
#[tokio::test]
async fn a_command_means_the_drive_that_has_the_name_when_it_arrives() {
    let dir = tempfile::tempdir().unwrap();
    let mut client = node(dir.path()).await;
    let before = client.common.plant.load_full();
    let point = before
        .drive("p1")
        .unwrap()
        .image
        .spec
        .profile
        .model_index(ModelPoint::Run);
    let order = |state| Order::Points(vec![(point.unwrap(), Value::Bool(state))]);
    session::Client::on_message(&mut client, run(true));
    assert_eq!(ordered(&before), Some((0, order(true))));
    assert!(!session::Client::is_idle(&client), "it waits for the confirmation");
    // A reload exchanges the names.
    let after = Arc::new(fixture::plant(&["p2", "p1"]));
    fixture::read(&after, "p1", 1, 0, Instant::now());
    client.common.plant.store(after.clone());
    session::Client::on_message(&mut client, run(false));
    assert_eq!(ordered(&before), None, "the machine that had the name before");
    assert_eq!(ordered(&after), Some((1, order(false))));
}
