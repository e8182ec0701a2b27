//! Recordings: their list, and one of them as JSON, as CSV or as a capture.

use std::sync::Arc;

use axum::Json;
use axum::extract::{Path, RawQuery, State};
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};

use super::app_state::AppState;
use super::query::{self, QueryError};
use super::replies::{Replied, not_found, refused};
use drivegate_core::history::recording::ENDING;
use drivegate_core::history::{Recording, export, pcapng};

/// The output formats of a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Form {
    Json,
    Csv,
    Pcap,
    /// The gateway's own file format.
    Dgrec,
}

impl Form {
    /// Content type, and the end of the name of a file.
    fn kind(self) -> (&'static str, &'static str) {
        match self {
            Form::Json => ("application/json", "json"),
            Form::Csv => ("text/csv; charset=utf-8", "csv"),
            Form::Pcap => ("application/x-pcapng", "pcapng"),
            Form::Dgrec => ("application/octet-stream", ENDING),
        }
    }

    fn of(self, recording: &Recording) -> Vec<u8> {
        match self {
            Form::Json => export::json(recording).into_bytes(),
            Form::Csv => export::csv(recording).into_bytes(),
            Form::Pcap => pcapng::pcapng(recording),
            Form::Dgrec => recording.to_bytes(),
        }
    }
}

/// The output format requested in the query.
fn form(query: Option<&str>) -> Result<Form, QueryError> {
    let [format] = query::parameters(query, &["format"])?;
    match format.as_deref() {
        None | Some("json") => Ok(Form::Json),
        Some("csv") => Ok(Form::Csv),
        Some("pcap") => Ok(Form::Pcap),
        Some("dgrec") => Ok(Form::Dgrec),
        Some(other) => Err(QueryError::Value {
            name: "format",
            value: other.to_string(),
            expected: "it is `json`, `csv`, `pcap` or `dgrec`",
        }),
    }
}

/// Handler: the recordings, oldest first.
pub(super) async fn list(State(app): State<Arc<AppState>>) -> Response {
    let _turn = app.turn().await;
    let entries = app.north.recordings.list();
    Json(entries.iter().map(Arc::as_ref).collect::<Vec<_>>()).into_response()
}

/// A recording with all its samples and frames; with `format=csv` its samples, with `format=pcap` its frames, with
/// `format=dgrec` as the gateway keeps it, as a file.
pub(super) async fn one(
    State(app): State<Arc<AppState>>,
    Path(id): Path<String>,
    RawQuery(query): RawQuery,
) -> Replied {
    let form = form(query.as_deref())?;
    let recordings = app.north.recordings.clone();
    let wanted = id.clone();
    let read = app.read_files(move || {
        let read = recordings.read(&wanted);
        read.map(|read| read.map(|recording| form.of(&recording)))
    });
    match read.await? {
        Some(Ok(bytes)) => {
            let (content_type, end) = form.kind();
            let mut response = ([(header::CONTENT_TYPE, content_type)], bytes).into_response();
            // An id that there is consists of letters, digits, `-`, `_`, `.` and `:`.
            let named = format!("attachment; filename=\"{id}.{end}\"").parse();
            if let (Ok(named), true) = (named, form != Form::Json) {
                response.headers_mut().insert(header::CONTENT_DISPOSITION, named);
            }
            Ok(response)
        }
        Some(Err(error)) => Err(refused(StatusCode::INTERNAL_SERVER_ERROR, error.to_string())),
        None => Err(not_found(format!("there is no recording `{id}`"), Vec::new())),
    }
}
