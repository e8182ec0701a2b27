//! The documentation as text, from the program itself: a plant's network often has no way to the internet.

use std::fmt::Write as _;

use axum::extract::Path;
use axum::http::{Uri, header};
use axum::response::{IntoResponse, Response};

use super::views;

macro_rules! documents {
    ($($name:literal),+ $(,)?) => {
        &[$((concat!($name, ".md"), include_str!(concat!("../../../docs/", $name, ".md")))),+]
    };
}

/// Name and text of each, in the order of `docs/SUMMARY.md`.
const DOCUMENTS: &[(&str, &str)] = documents![
    "installation",
    "commissioning",
    "configuration",
    "command-line",
    "upgrading",
    "safety",
    "modbus-tcp",
    "mqtt",
    "sparkplug",
    "home-assistant",
    "integrations",
    "bacnet",
    "http",
    "fleet",
    "commands",
    "status-page",
    "troubleshooting",
    "history",
    "parameters",
    "tool-slot",
    "drives",
    "profiles",
    "verifying",
    "n2",
    "simulate",
    "performance",
];

/// The list of all.
pub(super) async fn list() -> Response {
    let head = "<!DOCTYPE html><html lang=\"en\"><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\">\
                <meta name=\"color-scheme\" content=\"light dark\"><title>drivegate: documentation</title><h1>Documentation</h1><ul>";
    let mut html = head.to_string();
    for (name, text) in DOCUMENTS {
        let title = text.lines().next().unwrap_or_default().trim_start_matches("# ");
        // Writing to a string cannot fail.
        let _ = write!(html, "<li><a href=\"{name}\">{title}</a>");
    }
    views::document(html)
}

pub(super) async fn one(Path(wanted): Path<String>, uri: Uri) -> Response {
    match DOCUMENTS.iter().find(|(name, _)| *name == wanted) {
        Some((_, text)) => ([(header::CONTENT_TYPE, "text/plain; charset=utf-8")], *text).into_response(),
        None => views::unknown(uri).await,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Documents for developers are with the sources.
    #[test]
    fn every_document_for_operators_is_served() {
        let (summary, _) = include_str!("../../../docs/SUMMARY.md")
            .split_once("# Build")
            .expect("a part for developers");
        let named: Vec<&str> = summary
            .split("](")
            .skip(2)
            .filter_map(|rest| rest.split_once(')'))
            .map(|(name, _)| name)
            .collect();
        let served: Vec<&str> = DOCUMENTS.iter().map(|(name, _)| *name).collect();
        assert_eq!(named, served);
        for (name, text) in DOCUMENTS {
            let title = text.lines().next().unwrap_or_default();
            assert!(
                title.starts_with("# ") && !title.contains(['<', '&']),
                "{name}: {title}"
            );
        }
    }
}
