//! The status page in a real browser.

#[path = "page/lively.rs"]
mod lively;
#[path = "page/pictures.rs"]
mod pictures;

use std::time::{Duration, Instant};

use super::plant::{self as hand_made, Server, event};
use crate::support::tools::{root, tool};

use drivegate_core::event::EventKind;

use self::lively::Lively;

/// A text that must be shown as text.
const NASTY: &str = "<img src=x onerror=window.hacked=1>";

/// Runs a script of `tests/north/http/page`, which controls the browser; returns its output.
async fn browse(script: &str, arguments: Vec<String>) -> String {
    let script = root().join("tests/north/http/page").join(script);
    let run = move || {
        std::process::Command::new(tool("timeout"))
            .arg("900")
            .arg(tool("node"))
            .arg(script)
            .args(arguments)
            .env("NODE_PATH", root().join(".tools/node/node_modules"))
            .output()
            .expect("it runs")
    };
    let output = tokio::task::spawn_blocking(run).await.expect("it ends");
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{}\n{errors}", output.status);
    String::from_utf8(output.stdout).expect("text")
}

fn url(server: &Server) -> String {
    format!("http://{}/", server.address)
}

/// Contents, size and accessibility of every view, in light and dark, from desktop to phone, by keyboard alone.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_view_is_complete_and_accessible() {
    let Lively {
        mut plant,
        stats,
        mut going_on,
    } = Lively::new();
    let nasty = hand_made::drive("line3", NASTY, 9, &hand_made::nx());
    let never = hand_made::drive("line3", "never-1", 2, &hand_made::nx());
    plant.buses.push(hand_made::bus("line3", vec![nasty.clone(), never]));
    plant.buses.push(hand_made::bus("line4", Vec::new()));
    hand_made::open(&plant.buses[2]);
    plant.buses[3].image.update_health(|health| {
        health.tried = true;
        health.reason = Some("the adapter is gone".to_string());
    });
    plant.events.publish(event(EventKind::Fault, NASTY, NASTY));
    let server = Server::showing(plant, stats).await;
    let _answering = keep_answering(move || {
        hand_made::answer(&nasty, Instant::now(), hand_made::nx_faulted);
        going_on.answer();
    });
    browse("views.js", vec![url(&server)]).await;
}

/// The views follow changes of drives, profiles, filters and the connection.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_page_follows_its_gateway() {
    browse("changes.js", Vec::new()).await;
}

/// A stop that was not carried out is clearly shown, references are accepted in the form typed, and a start shows
/// its direction.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn drives_are_operated_from_the_page() {
    browse("operating.js", Vec::new()).await;
}

/// A key that is held down answers no question, and a question closes when its basis changes.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn questions_are_answered_about_what_they_asked() {
    browse("questions.js", Vec::new()).await;
}

/// A drive is taken, taken over and released while its motor keeps running.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_running_drive_is_taken_over() {
    browse("hold.js", Vec::new()).await;
}

/// The overview of 60 drives after login: compact rows, and colours only for drives that need the attention of a person.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn sixty_drives_are_seen_at_a_glance() {
    browse("rows.js", Vec::new()).await;
}

/// Buttons keep their place and the focus when pressed, and are large enough for a finger.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_page_fits_the_hand() {
    browse("hand.js", Vec::new()).await;
}

/// The time that an update takes grows with the number of drives and no faster.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_thousand_drives_stay_smooth() {
    let printed = browse("load.js", Vec::new()).await;
    println!("{printed}");
}

/// Calls `answer` every second until the result is dropped.
fn keep_answering(mut answer: impl FnMut() + Send + 'static) -> tokio_util::task::AbortOnDropHandle<()> {
    tokio_util::task::AbortOnDropHandle::new(tokio::spawn(async move {
        loop {
            answer();
            tokio::time::sleep(Duration::from_millis(900)).await;
        }
    }))
}
