//! The status page in a real browser.

use super::plant::{self, Server, event};
use crate::support::tools::{root, run, tool};

use drivegate::event::EventKind;

/// The document after its script has run for some seconds of the browser's own time, without the tables
/// that are there for browsers without scripts.
fn dom(address: std::net::SocketAddr) -> String {
    let profile = tempfile::tempdir().expect("a directory");
    let profile = format!("--user-data-dir={}", profile.path().display());
    let url = format!("http://{address}/");
    let arguments = [
        "120",
        "chromium",
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-quic",
        "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
        &profile,
        "--virtual-time-budget=5000",
        "--dump-dom",
        &url,
    ];
    let output = run(&tool("timeout"), &arguments);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(
        output.status.success(),
        "{}: is Debian's package chromium installed?\n{errors}",
        output.status
    );
    let document = String::from_utf8(output.stdout).expect("text");
    let mut rest = document.as_str();
    let mut live = String::new();
    while let Some((before, after)) = rest.split_once("<noscript>") {
        live += before;
        rest = after.split_once("</noscript>").map_or("", |(_, after)| after);
    }
    live + rest
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_page_shows_the_plant() {
    let plant = plant::mixed();
    plant
        .events
        .publish(event(EventKind::Fault, "saw-4", "fault 7: <saturation> trip"));
    plant.buses[1].image.update_health(|health| {
        health.up = false;
        health.reason = Some("the adapter is gone".to_string());
    });
    let server = Server::of(plant).await;
    let address = server.address;
    let document = tokio::task::spawn_blocking(move || dom(address))
        .await
        .expect("a document");
    for wanted in [
        ">Live<",
        "aria-expanded=\"false\">pump-1</button>",
        "▶ running",
        "<span class=\"value main\">25.00</span><span class=\"unit\"> Hz</span>",
        ">fan-2<",
        "✕ offline",
        "<span class=\"value stale\" title=\"stale, ",
        ">mixer-3<",
        "<span class=\"value bad\">never read</span>",
        ">saw-4<",
        "▲ fault",
        "F7 saturation trip",
        "1 of 3</dd>",
        "12.5 ms (aim 10 ms)",
        "43.8 %",
        "the adapter is gone",
        "fault 7: &lt;saturation&gt; trip",
    ] {
        assert!(document.contains(wanted), "{wanted}\nis missing in\n{document}");
    }
}

/// What a row shows of points that a reload replaced, of texts, ages, speeds that a newer state contradicts, and causes.
#[test]
fn rows_follow_their_drive() {
    let here = root().join("tests/north/http/page_rows.js");
    let script = root().join("src/north/http/page/page.js");
    let output = run(&tool("node"), &[here.to_str().unwrap(), script.to_str().unwrap()]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}
