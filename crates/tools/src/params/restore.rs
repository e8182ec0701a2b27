//! `drivegate params restore` and `clone`: show the plan, then write it.

use std::io::{BufRead as _, IsTerminal as _, Write as _};
use std::path::PathBuf;
use std::process::ExitCode;

use super::super::client::Gateway;
use super::super::drive_access::target;
use super::super::failure::{Failure, Outcome, negative};
use super::super::{EXIT_FAILED, EXIT_USAGE, report};
use super::{StatusLine, read_from_drive, read_written};
use drivegate_core::parameters::{Entry, Id, ParameterFile};
use drivegate_http::messages::{ReadParameters, Restore, RestoreAct, RestoreWish, Stage};

#[derive(Debug, clap::Args)]
pub(super) struct RestoreArgs {
    /// File that `params read` wrote.
    #[arg(required_unless_present_any = ["resume", "undo", "release", "look"])]
    file: Option<PathBuf>,
    /// Name of the drive to restore it to.
    #[arg(required_unless_present_any = ["resume", "undo", "release", "look"])]
    drive: Option<String>,
    #[command(flatten)]
    how: How,
    /// Writes the rest of an interrupted restore.
    #[arg(long, value_name = "DRIVE", conflicts_with_all = ["file", "drive", "only", "force", "yes", "dry_run"])]
    resume: Option<String>,
    /// Writes back the former values of an interrupted restore.
    #[arg(long, value_name = "DRIVE", conflicts_with_all = ["file", "drive", "only", "force", "yes", "dry_run", "resume"])]
    undo: Option<String>,
    /// Leaves the drive as an interrupted restore left it, and accepts all commands again. A running restore ends
    /// before its next parameter.
    #[arg(long, value_name = "DRIVE", conflicts_with_all = ["file", "drive", "only", "force", "yes", "dry_run", "resume", "undo"])]
    release: Option<String>,
    /// Shows the progress of a restore until it ends.
    #[arg(long, value_name = "DRIVE", conflicts_with_all = ["file", "drive", "only", "force", "yes", "dry_run", "resume", "undo", "release"])]
    look: Option<String>,
}

#[derive(Debug, clap::Args)]
pub(super) struct How {
    /// Only this parameter; may be given several times, also for those that are otherwise never restored.
    #[arg(long, value_name = "ID")]
    only: Vec<String>,
    /// Restores to a drive that differs; the risks are listed.
    #[arg(long)]
    force: bool,
    /// Writes without asking.
    #[arg(long)]
    yes: bool,
    /// Shows what would be written, and writes nothing.
    #[arg(long, conflicts_with = "yes")]
    dry_run: bool,
}

pub(super) fn restore(gateway: &Gateway, args: &RestoreArgs) -> Outcome {
    let again = [
        (&args.resume, Some(RestoreAct::Resume)),
        (&args.undo, Some(RestoreAct::Undo)),
        (&args.release, Some(RestoreAct::Release)),
        (&args.look, None),
    ];
    for (drive, act) in again {
        if let Some(drive) = drive {
            return carry(gateway, drive, act, &args.how);
        }
    }
    // clap ensures that both are present.
    let (Some(file), Some(drive)) = (&args.file, &args.drive) else {
        return Err(Failure::Reported(EXIT_USAGE));
    };
    write(gateway, &read_written(file)?, drive, &args.how)
}

/// Reads one drive and restores that to another.
pub(super) fn clone(gateway: &Gateway, from: &str, to: &str, how: &How) -> Outcome {
    if from == to {
        let why = "a drive cannot be cloned to itself; command line; name two drives";
        return Err(Failure::Misused(why.to_string()));
    }
    let brisk = ReadParameters {
        brisk: true,
        ..ReadParameters::default()
    };
    let (file, _) = read_from_drive(gateway, from, brisk)?;
    write(gateway, &file, to, how)
}

fn write(gateway: &Gateway, file: &ParameterFile, drive: &str, how: &How) -> Outcome {
    let act = RestoreAct::Prepare(RestoreWish {
        file: without_notes(file).text(),
        only: how.only.clone(),
        force: how.force,
    });
    carry(gateway, drive, Some(act), how)
}

/// The file without its text notes, which the gateway has itself.
fn without_notes(file: &ParameterFile) -> ParameterFile {
    let bare = |(id, entry): (&Id, &Entry)| {
        let value = entry.value.clone().map_err(|_| String::new());
        let note = String::new();
        (id.clone(), Entry { value, note })
    };
    ParameterFile {
        values: file.values.iter().map(bare).collect(),
        ..file.clone()
    }
}

fn carry(gateway: &Gateway, drive: &str, act: Option<RestoreAct>, how: &How) -> Outcome {
    let target = target(gateway, drive)?;
    let line = std::cell::RefCell::new(StatusLine::default());
    let mut refused_to_write = None;
    let shown = std::cell::Cell::new(false);
    let agreed = |prepared: &Restore| {
        line.borrow().end();
        report::print(&plan_text(prepared));
        shown.set(true);
        match agrees(drive, how) {
            Ok(()) => true,
            Err(why) => {
                refused_to_write = Some(why);
                false
            }
        }
    };
    let progress = |status: &Restore| {
        let what = match status.stage {
            Stage::Reading => "addresses read",
            _ => "parameters written",
        };
        let waits = status
            .waits
            .as_ref()
            .map(|why| format!(", waits: {why}"))
            .unwrap_or_default();
        line.borrow_mut()
            .show(&format!("{} of {} {what}{waits}", status.done, status.total));
    };
    let ended = target.restore_parameters(act, agreed, progress);
    line.borrow().end();
    if let Some(why) = refused_to_write {
        return Err(why);
    }
    let ended = ended?;
    let text = ended.text.clone().unwrap_or_default();
    match ended.stage {
        Stage::Done => {
            if !shown.get() {
                report::print(&plan_text(&ended));
            }
            report::note(&text);
            Ok(ExitCode::SUCCESS)
        }
        Stage::Refused => {
            for reason in &ended.reasons {
                report::error(reason);
            }
            negative()
        }
        Stage::Prepared => {
            report::note(&format!("a restore to `{drive}` is prepared, and nothing was written"));
            Ok(ExitCode::SUCCESS)
        }
        _ => Err(text.into()),
    }
}

/// The plan of a restore as text.
fn plan_text(prepared: &Restore) -> String {
    let plan = prepared.plan.clone().unwrap_or_default();
    let risks = prepared
        .risks
        .iter()
        .map(|risk| format!("forced, at your risk: {risk}\n"));
    plan + &risks.collect::<String>()
}

/// Asks whether the prepared restore is to be written.
///
/// # Errors
/// If the restore is not confirmed; without a message if only the plan was requested.
fn agrees(drive: &str, how: &How) -> Result<(), Failure> {
    if how.dry_run {
        return Err(Failure::Reported(0));
    }
    if how.yes {
        return Ok(());
    }
    let (stdin, mut stderr) = (std::io::stdin(), std::io::stderr());
    if !stdin.is_terminal() || !stderr.is_terminal() {
        return Err(
            "nothing was written: there is no terminal to ask on; command line; add --yes to write, or --dry-run"
                .into(),
        );
    }
    // A terminal that has been closed gives no answer.
    let _ = write!(stderr, "Write that to {drive}? [y/N] ");
    let mut answer = String::new();
    let _ = stdin.lock().read_line(&mut answer);
    match answer.trim() {
        "y" | "Y" | "yes" => Ok(()),
        _ => {
            report::note("nothing was written");
            Err(Failure::Reported(EXIT_FAILED))
        }
    }
}
