//! The pictures of the documentation: created on request (`DRIVEGATE_WRITE_PICTURES=1`), otherwise only checked.

use std::collections::BTreeSet;
use std::fs;

use super::super::plant::Server;
use super::lively::Lively;
use super::{browse, keep_answering, url};
use crate::support::tools::root;

/// Size limit, because pictures are also viewed over slow lines.
const MOST_BYTES: u64 = 200 * 1024;

/// The pages of the pictures render; with `DRIVEGATE_WRITE_PICTURES=1` they are written to `docs/pictures`.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pictures_show_the_pages() {
    let Lively {
        plant,
        stats,
        mut going_on,
    } = Lively::new();
    let server = Server::showing(plant, stats).await;
    let _answering = keep_answering(move || going_on.answer());
    let elsewhere = tempfile::tempdir().expect("a directory");
    let dir = match std::env::var_os("DRIVEGATE_WRITE_PICTURES") {
        Some(_) => root().join("docs/pictures"),
        None => elsewhere.path().to_path_buf(),
    };
    browse("pictures.js", vec![url(&server), dir.display().to_string()]).await;
    let names = |dir: &std::path::Path| -> BTreeSet<String> {
        let files = fs::read_dir(dir).expect("the pictures");
        files
            .map(|file| file.expect("a file").file_name().into_string().expect("a name"))
            .collect()
    };
    assert_eq!(
        names(&dir),
        names(&root().join("docs/pictures")),
        "DRIVEGATE_WRITE_PICTURES=1 makes them anew"
    );
    for name in names(&dir) {
        let size = |dir: &std::path::Path| fs::metadata(dir.join(&name)).expect("a file").len();
        assert!(size(&dir) > 10_000, "{name} shows nothing");
        assert!(size(&root().join("docs/pictures")) < MOST_BYTES, "{name} is too large");
    }
}

/// Every picture is used in a document, and every used picture exists.
#[test]
fn pictures_are_those_of_the_documents() {
    let mut shown = BTreeSet::new();
    for document in ["README.md", "docs/status-page.md"] {
        let text = fs::read_to_string(root().join(document)).expect("a document");
        let names = text
            .split("pictures/")
            .skip(1)
            .filter_map(|rest| rest.split_once(".png"));
        shown.extend(names.map(|(name, _)| format!("{name}.png")));
    }
    let files = fs::read_dir(root().join("docs/pictures")).expect("the pictures");
    let files: BTreeSet<String> = files
        .map(|file| file.unwrap().file_name().into_string().unwrap())
        .collect();
    assert_eq!(shown, files);
}
