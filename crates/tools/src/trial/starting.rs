//! What is missing until a motor can be started from the page: printed, never done. Pure.

use std::path::Path;

use drivegate_core::process_image::DriveSpec;
use drivegate_gateway::config::BusSettings;
use drivegate_model::drive::ModelPoint;

/// Who is added as a user in the printed command.
const USER: &str = "alice";

/// The next commands with the configuration `file`; with a drive that can be started, also the steps to a start.
pub(super) fn next_steps(file: &Path, buses: &[BusSettings], before_commands: &str) -> String {
    let shown = file.display();
    let run = format!("  drivegate check --config {shown}\n  drivegate run --config {shown}\n");
    let written = format!("Configuration written to {shown}. Next, after Ctrl-C:\n{run}");
    let can_start = |drive: &&DriveSpec| drive.profile.model_index(ModelPoint::Run).is_some();
    let drive = buses.iter().flat_map(|bus| &bus.drives).find(can_start);
    written
        + &drive
            .map(|drive| start(file, drive, before_commands))
            .unwrap_or_default()
}

/// The steps from the configuration to a start.
fn start(file: &Path, drive: &DriveSpec, before_commands: &str) -> String {
    let shown = file.display();
    let directory = file.parent().unwrap_or(Path::new(""));
    let users = directory.join("users");
    let out = if directory.as_os_str().is_empty() {
        Path::new(".")
    } else {
        directory
    };
    let (users, out) = (users.display(), out.display());
    let limits = match drive.profile.model_index(ModelPoint::SpeedReference) {
        Some(_) => "         limits = { speed_reference = [0.0, 50.0] }\n",
        None => "",
    };
    let at_the_drive = match before_commands {
        "" => String::new(),
        lines => format!("\nAt the drive, {lines}"),
    };
    format!(
        "\nTo start {name} from the page, when its machine may turn:\n  \
         1. In {shown}, below `name = \"{name}\"`:\n         access = \"control\"\n{limits}         \
         supervision = {{ timeout = \"5s\", action = \"stop\" }}\n     and below [http]:\n         commands = true\n         \
         users_file = \"users\"\n  \
         2. drivegate user add --file {users} {USER}\n  \
         3. drivegate check --config {shown}\n     drivegate run --config {shown}\n  \
         4. Open http://127.0.0.1:9488/, log in as {USER}, open {name}, Start …\n\
         From other machines, with its lines below [http]: drivegate certificate new --host NAME --out {out}\n{at_the_drive}",
        name = drive.name
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use drivegate_gateway::config::Settings;

    const FOUND: &str = "[gateway]\nname = \"g\"\n[[bus]]\nname = \"line1\"\nport = \"/dev/x\"\nbaud = 38400\ncycle = \"1s\"\n\
        [[bus.drive]]\nname = \"drive-1\"\naddress = 1\nprofile = \"PROFILE\"\n[http]\n";

    fn buses(text: &str) -> Vec<BusSettings> {
        let loaded = Settings::parse("plant.toml", text, std::iter::empty());
        assert!(loaded.errors.is_empty(), "{:?}", loaded.errors);
        loaded.settings.unwrap().buses
    }

    /// The lines that are printed, put where they are said to go, are a configuration without complaints.
    #[test]
    fn the_printed_lines_make_the_configuration() {
        for profile in ["vacon-nx", "weg-cfw", "siemens-g120"] {
            let text = FOUND.replace("PROFILE", profile);
            let folder = tempfile::tempdir().unwrap();
            let file = folder.path().join("plant.toml");
            let steps = next_steps(&file, &buses(&text), "");
            let lines = |from: &str, to: &str| {
                let (_, behind) = steps.split_once(from).unwrap_or_else(|| panic!("{from} in {steps}"));
                behind.split_once(to).unwrap().0.trim().to_string() + "\n"
            };
            let of_drive = lines("below `name = \"drive-1\"`:\n", "     and below");
            let of_http = lines("and below [http]:\n", "  2. ");
            let user = drivegate_http::User::new("alice", "a long password").unwrap();
            let users = crate::credentials_file::CredentialsFile::open(&folder.path().join("users"));
            users.put(&user, true).unwrap();
            let text = text
                .replace("name = \"drive-1\"\n", &format!("name = \"drive-1\"\n{of_drive}"))
                .replace("[http]\n", &format!("[http]\n{of_http}"));
            let loaded = Settings::parse(&file, &text, std::iter::empty());
            let all: Vec<String> = [loaded.errors, loaded.warnings]
                .into_iter()
                .flatten()
                .map(|problem| problem.to_string())
                .collect();
            assert_eq!(all, [""; 0], "{profile}\n{text}");
            assert!(
                steps.contains(&format!("--file {} alice", folder.path().join("users").display())),
                "{steps}"
            );
        }
    }

    #[test]
    fn what_cannot_be_started_is_only_run() {
        let steps = next_steps(
            Path::new("plant.toml"),
            &buses(&FOUND.replace("PROFILE", "lenze-i550")),
            "",
        );
        assert!(steps.ends_with("drivegate run --config plant.toml\n"), "{steps}");
        let nx = buses(&FOUND.replace("PROFILE", "vacon-nx"));
        let steps = next_steps(Path::new("plant.toml"), &nx, "before the first command:\n  x\n");
        assert!(
            steps.contains("--file users alice\n") && steps.contains("--out .\n"),
            "{steps}"
        );
        assert!(
            steps.ends_with("\nAt the drive, before the first command:\n  x\n"),
            "{steps}"
        );
    }
}
