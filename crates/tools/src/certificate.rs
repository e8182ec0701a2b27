//! `drivegate certificate`: a key and a certificate for the HTTP server of a plant that has no CA.

use std::fs::{self, OpenOptions};
use std::io::Write;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use rcgen::{CertificateParams, DnType, ExtendedKeyUsagePurpose, IsCa, KeyPair, KeyUsagePurpose};
use ring::digest::{SHA256, digest};

use super::check::group_remedy;
use super::failure::Outcome;
use super::{printable, report};
use drivegate_http::is_host;

const DAY: Duration = Duration::from_secs(86_400);
/// Name of the certificate file.
const CERTIFICATE: &str = "http.crt";
const KEY: &str = "http.key";

/// Makes a key and a self-signed certificate for [http]
///
/// A browser warns once of a certificate that no CA has signed; compare the fingerprint then.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  \
    drivegate certificate new --host gateway.plant.example --host 192.168.1.20 --out /etc/drivegate")]
pub(super) struct Args {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, clap::Subcommand)]
enum Action {
    /// Writes http.key (mode 0600) and http.crt, and prints the lines for the configuration. Overwrites nothing.
    #[command(after_help = "Example:\n  drivegate certificate new --host gateway.plant.example --out /etc/drivegate")]
    New {
        /// Name or address by which browsers reach the gateway; may be repeated.
        #[arg(long = "host", value_name = "NAME", required = true, value_parser = host)]
        hosts: Vec<String>,
        /// Directory of the files.
        #[arg(long, value_name = "DIR", default_value = ".")]
        out: PathBuf,
        /// Days for which it is valid; browsers take 825 at most.
        #[arg(long, value_name = "NUMBER", default_value_t = 825, value_parser = clap::value_parser!(u16).range(1..=3650))]
        days: u16,
    },
}

fn host(text: &str) -> Result<String, String> {
    if is_host(text) {
        Ok(text.trim_start_matches('[').trim_end_matches(']').to_string())
    } else {
        Err("it is not a host name or an address; write it without scheme and port".to_string())
    }
}

pub(super) fn run(args: &Args) -> Outcome {
    let Action::New { hosts, out, days } = &args.action;
    Ok(report::print(&new(hosts, out, *days, SystemTime::now())?))
}

/// Writes certificate and key, or neither.
fn new(hosts: &[String], out: &Path, days: u16, now: SystemTime) -> Result<String, String> {
    let made = Made::new(hosts, days, now)?;
    let (key, certificate) = (out.join(KEY), out.join(CERTIFICATE));
    for file in [&key, &certificate] {
        if file.exists() {
            return Err(format!(
                "{} exists already, and nothing was written; remove it, or choose another directory with --out",
                file.display()
            ));
        }
    }
    write(&key, 0o600, &made.key)?;
    if let Err(error) = write(&certificate, 0o644, &made.certificate) {
        // The key alone is of no use.
        let _ = fs::remove_file(&key);
        return Err(error);
    }
    let shown = |path: &Path| std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf());
    let remedy = group_remedy(&shown(&key), "g+r");
    let [key, certificate] = [key, certificate].map(|path| format!("{:?}", shown(&path).display().to_string()));
    let (until, fingerprint) = (&made.until, &made.fingerprint);
    let names: Vec<String> = hosts
        .iter()
        .map(|host| format!("{:?}", printable::line(host)))
        .collect();
    Ok(format!(
        "The certificate is valid until {until}; its SHA-256 fingerprint, which browsers show, is\n{fingerprint}\n\n\
         [http]\nlisten = \"0.0.0.0:9488\"\nhosts = [{}]\ncertificate = {certificate}\nkey = {key}\n\n\
         For the service to read the key, {remedy}; check with `drivegate check --as-service`.\n",
        names.join(", ")
    ))
}

/// A key and its certificate, both as PEM.
struct Made {
    key: String,
    certificate: String,
    until: String,
    fingerprint: String,
}

impl Made {
    fn new(hosts: &[String], days: u16, now: SystemTime) -> Result<Made, String> {
        let failed = |error: rcgen::Error| format!("cannot make a certificate: {error}; --host; check the names");
        let mut params = CertificateParams::new(hosts.to_vec()).map_err(failed)?;
        let name = hosts.first().map_or("drivegate", String::as_str);
        params.distinguished_name.push(DnType::CommonName, name);
        params.is_ca = IsCa::ExplicitNoCa;
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth];
        // The certificate is valid from yesterday, because the clock of the browser may be behind.
        let (from, until) = (now - DAY, now + DAY * u32::from(days));
        let at = |(year, month, day)| rcgen::date_time_ymd(year, month, day);
        params.not_before = at(date(from)?);
        params.not_after = at(date(until)?);
        let key = KeyPair::generate().map_err(failed)?;
        let certificate = params.self_signed(&key).map_err(failed)?;
        let bytes = digest(&SHA256, certificate.der());
        let hex: Vec<String> = bytes.as_ref().iter().map(|byte| format!("{byte:02X}")).collect();
        Ok(Made {
            key: key.serialize_pem(),
            certificate: certificate.pem(),
            until: day(until),
            fingerprint: hex.join(":"),
        })
    }
}

/// `2028-03-01`.
fn day(time: SystemTime) -> String {
    humantime::format_rfc3339_seconds(time)
        .to_string()
        .chars()
        .take(10)
        .collect()
}

/// The date as year, month and day.
fn date(time: SystemTime) -> Result<(i32, u8, u8), String> {
    let text = day(time);
    let mut parts = text.split('-');
    let mut number = || parts.next().and_then(|part| part.parse::<u16>().ok());
    let (year, month, day) = (number(), number(), number());
    match (year, month.map(u8::try_from), day.map(u8::try_from)) {
        (Some(year), Some(Ok(month)), Some(Ok(day))) => Ok((year.into(), month, day)),
        _ => Err("the clock of this machine shows no date of today; set it".to_string()),
    }
}

fn write(path: &Path, mode: u32, text: &str) -> Result<(), String> {
    let write = || {
        let mut file = OpenOptions::new().write(true).create_new(true).mode(mode).open(path)?;
        file.write_all(text.as_bytes())?;
        file.sync_all()
    };
    write().map_err(|error: std::io::Error| format!("cannot write {}: {error}; check the directory", path.display()))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::MetadataExt;

    use super::*;

    #[test]
    fn both_files_are_there_and_nothing_is_overwritten() {
        let dir = tempfile::tempdir().unwrap();
        let hosts = ["gateway.example".to_string(), "192.0.2.7".to_string()];
        let text = new(&hosts, dir.path(), 825, SystemTime::now()).unwrap();
        assert!(text.contains("hosts = [\"gateway.example\", \"192.0.2.7\"]"), "{text}");
        let (key, certificate) = (dir.path().join(KEY), dir.path().join(CERTIFICATE));
        assert!(text.contains(&format!("chmod g+r {}", key.display())), "{text}");
        assert_eq!(fs::metadata(&key).unwrap().mode() & 0o777, 0o600);
        let before = fs::read(&key).unwrap();
        let error = new(&hosts, dir.path(), 825, SystemTime::now()).unwrap_err();
        assert!(error.contains("http.key exists already"), "{error}");
        fs::remove_file(&key).unwrap();
        let error = new(&hosts, dir.path(), 825, SystemTime::now()).unwrap_err();
        assert!(error.contains("http.crt exists already") && !key.exists(), "{error}");
        assert!(certificate.exists() && !before.is_empty());
        let missing = new(&hosts, &dir.path().join("none"), 825, SystemTime::now()).unwrap_err();
        assert!(missing.contains("cannot write"), "{missing}");
    }

    #[test]
    fn hosts_are_names_and_addresses() {
        assert_eq!(host("gateway.example"), Ok("gateway.example".to_string()));
        assert_eq!(host("[::1]"), Ok("::1".to_string()));
        assert!(host("https://gateway").is_err() && host("a:80").is_err());
    }
}
