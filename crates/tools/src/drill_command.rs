//! `drivegate drill`: proves that a motor stops, and shows what was proven.

mod page;

use std::io::Write as _;
use std::process::ExitCode;
use std::time::Duration;

use serde_json::json;

use super::client::{Client, Gateway, GatewayRequest, encoded};
use super::failure::{Failure, Outcome, documented};
use super::{printable, report};
use drivegate_core::drill::{DrillReport, DrillState, Kind};
use drivegate_http::messages::DrillWish;

/// Time between two looks at a running drill.
const LOOK: Duration = Duration::from_millis(500);

/// Proves that a motor stops: by a command, when its client goes silent, when the gateway goes silent.
///
/// The motor is started at low speed and stopped in each way, and the time to standstill is measured. You must type the
/// drive's name before it starts; Ctrl-C ends the drill and stops the motor. One person watches the machine
/// with a hand on its switch; nobody is in its danger zone.
#[derive(Debug, clap::Args)]
#[command(
    args_conflicts_with_subcommands = true,
    after_help = "Examples:
  drivegate drill --config drivegate.toml pump-1 --order --client --speed 10
  drivegate drill list --config drivegate.toml
  drivegate drill report --config drivegate.toml 20261128T074744.695Z-pump-1 > report.html"
)]
pub(super) struct Args {
    #[command(subcommand)]
    shown: Option<Shown>,
    #[command(flatten)]
    wish: Wish,
}

#[derive(Debug, clap::Subcommand)]
enum Shown {
    /// Lists the known drills, newest first.
    #[command(after_help = "Example:\n  drivegate drill list --config drivegate.toml")]
    List {
        #[command(flatten)]
        gateway: Gateway,
        /// JSON instead of a table.
        #[arg(long)]
        json: bool,
    },
    /// Prints a drill as an HTML page.
    #[command(
        after_help = "Example:\n  drivegate drill report --config drivegate.toml 20261128T074744.695Z-pump-1 > report.html"
    )]
    Report {
        #[command(flatten)]
        gateway: Gateway,
        /// Id of the drill, as printed by `list`.
        id: String,
    },
}

#[derive(Debug, clap::Args)]
struct Wish {
    #[command(flatten)]
    gateway: Gateway,
    /// Name of the drive.
    drive: Option<String>,
    /// By a stop command.
    #[arg(long)]
    order: bool,
    /// When its client goes silent.
    #[arg(long)]
    client: bool,
    /// When the gateway goes silent: nothing is sent to the drive for `limit`.
    #[arg(long = "gateway")]
    silence: bool,
    /// Speed at which the motor is stopped, % [default: `max_speed` of [drill]].
    #[arg(long, value_name = "PERCENT")]
    speed: Option<f64>,
}

pub(super) fn run(args: &Args) -> Outcome {
    super::block_on(async {
        match (&args.shown, &args.wish.drive) {
            (Some(Shown::List { gateway, json }), _) => documented(*json, list(gateway, *json).await),
            (Some(Shown::Report { gateway, id }), _) => Ok(report::print(&printed(gateway, id).await?)),
            (None, Some(name)) => match drill(name, &args.wish).await? {
                passed if passed.state == DrillState::Passed => Ok(ExitCode::SUCCESS),
                ended => Err(format!("{}: {}", state_text(ended.state), ended.text).into()),
            },
            (None, None) => Err(Failure::Misused(
                "name the drive, or use `list` or `report ID`".to_string(),
            )),
        }
    })
}

async fn list(gateway: &Gateway, json: bool) -> Outcome {
    let drills: Vec<DrillReport> = asked(&gateway.client()?, &GatewayRequest::view("/api/v1/drills")).await?;
    if json {
        return Ok(report::json(&drills));
    }
    let mut table = report::table(["id", "drive", "result", "order", "client", "gateway", "by"]);
    for drill in &drills {
        let of = |kind: Kind| {
            let step = drill.steps.iter().find(|step| step.kind == kind);
            step.map_or_else(String::new, |step| match step.took_ms {
                Some(took) => format!("{} {:.1} s", state_text(step.state), seconds(took)),
                None => state_text(step.state),
            })
        };
        table.add_row([
            drill.id.clone(),
            drill.drive.clone(),
            state_text(drill.state),
            of(Kind::Order),
            of(Kind::Client),
            of(Kind::Gateway),
            drill.who.clone(),
        ]);
    }
    Ok(report::print(&report::lines(&table)))
}

async fn printed(gateway: &Gateway, id: &str) -> Result<String, String> {
    let drill = asked(&gateway.client()?, &GatewayRequest::view(path(id))).await?;
    Ok(page::of(&drill))
}

fn path(id: &str) -> String {
    format!("/api/v1/drills/{}", encoded(id))
}

async fn asked<T: serde::de::DeserializeOwned>(client: &Client, asked: &GatewayRequest) -> Result<T, String> {
    let reply = client.ask(asked).await.map_err(|error| error.to_string())?;
    reply.accepted(asked).map_err(|error| error.to_string())
}

async fn drill(name: &str, wish: &Wish) -> Result<DrillReport, String> {
    let client = wish.gateway.client()?;
    let chosen = [
        (Kind::Order, wish.order),
        (Kind::Client, wish.client),
        (Kind::Gateway, wish.silence),
    ];
    let kinds: Vec<Kind> = chosen
        .into_iter()
        .filter(|(_, wanted)| *wanted)
        .map(|(kind, _)| kind)
        .collect();
    let body = DrillWish {
        drive: name.to_string(),
        kinds,
        speed: wish.speed,
    };
    let armed: Result<DrillReport, String> = asked(&client, &GatewayRequest::post("/api/v1/drills", &body)).await;
    let take = format!("hold {name} take");
    let complete = |why: String| why.replace(&format!("drivegate {take}"), &wish.gateway.command(&take));
    let armed = armed.map_err(complete)?;
    let ways: Vec<&str> = armed.steps.iter().map(|step| step.kind.name()).collect();
    let warning = format!(
        "Drive {} will be started at {} % and stopped by: {}. Time allowed: {} s each.\nType its name to start the \
         motor: ",
        armed.drive,
        armed.speed,
        ways.join(", "),
        seconds(armed.limit_ms)
    );
    let typed = tokio::select! {
        typed = line(&warning) => typed?,
        () = interrupted() => String::new(),
    };
    if typed.trim() != armed.drive {
        // Ends the armed drill at once; otherwise it would end after a minute.
        let ended = asked::<DrillReport>(&client, &GatewayRequest::delete(path(&armed.id))).await;
        ended.map_err(|why| format!("{why}; nothing was started"))?;
        return Err("the name was not typed; nothing was started".to_string());
    }
    let lost = "it is unknown whether it started: check the motor, and stop it at the machine";
    let start = GatewayRequest::post(format!("{}/start", path(&armed.id)), &json!({})).if_lost(lost);
    let started: DrillReport = asked(&client, &start).await?;
    watch(&client, &wish.gateway, started).await
}

/// Shows the steps of the drill until it ends. Ctrl-C ends the drill.
async fn watch(client: &Client, gateway: &Gateway, started: DrillReport) -> Result<DrillReport, String> {
    let mut told = String::new();
    let mut now = started;
    loop {
        if now.text != told {
            told.clone_from(&now.text);
            report::note(&printable::line(&told));
        }
        if now.state.is_over() {
            let last = now.last_stop.as_deref().unwrap_or_default();
            report::note(&printable::line(&format!(
                "last stop: {last}; report: {}",
                gateway.command(&format!("drill report {}", now.id))
            )));
            return Ok(now);
        }
        let ends = tokio::select! {
            () = tokio::time::sleep(LOOK) => false,
            () = interrupted() => true,
        };
        let next = if ends {
            GatewayRequest::delete(path(&now.id))
                .if_lost("it is unknown whether the drill ended: stop the motor at its switch")
        } else {
            GatewayRequest::view(path(&now.id))
        };
        now = asked(client, &next).await?;
    }
}

async fn interrupted() {
    // Without a handler for the signal, Ctrl-C ends the process.
    if tokio::signal::ctrl_c().await.is_err() {
        std::future::pending::<()>().await;
    }
}

async fn line(prompt: &str) -> Result<String, String> {
    let mut stderr = std::io::stderr();
    // An error is ignored: an operator who cannot see the prompt types nothing.
    let _ = write!(stderr, "{}", printable::lines(prompt)).and_then(|()| stderr.flush());
    // A separate thread reads the input, because the command must not wait for it at its end.
    let (sender, typed) = tokio::sync::oneshot::channel();
    std::thread::spawn(move || {
        let mut line = String::new();
        // After Ctrl-C the receiver no longer exists, and the line is dropped.
        let _ = sender.send(std::io::stdin().read_line(&mut line).map(|_| line));
    });
    let read = typed.await.map_err(|error| error.to_string())?;
    read.map_err(|error| format!("cannot read the name: {error}"))
}

fn seconds(millis: u64) -> f64 {
    Duration::from_millis(millis).as_secs_f64()
}

fn state_text(state: DrillState) -> String {
    state.name().replace('_', " ")
}
