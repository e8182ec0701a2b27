//! Reads the section `[mqtt]`.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use super::key::Key;
use super::keys::{
    BUFFER, Broker, MQTT, MQTT_HOME_ASSISTANT, MQTT_QOS, PUBLISH, ProxyAddress, SPARKPLUG, TelemetryTopic,
};
use super::{files, values};
use drivegate_model::document::{Finding, FromNode, Reader, format_duration};
use drivegate_mqtt::{Buffer, Options, Password, Qos, Secret, SecretFault, Telemetry, sparkplug};
use drivegate_north::tls::{ServerIdentity, TlsFile};

/// Maximum number of brokers: with three attempts per second, all of them are tried within 10 s.
const MOST_BROKERS: usize = 16;

/// `url` and `urls`, in this order.
fn read_brokers(reader: &Reader<'_>) -> Option<Vec<Broker>> {
    let (first, more) = (MQTT.url.read(reader), MQTT.urls.get(reader));
    let brokers: Vec<Broker> = std::iter::once(first?).chain(more).collect();
    let mut before: Vec<(&str, u16)> = Vec::new();
    for broker in &brokers {
        let address = (broker.host.as_str(), broker.port);
        let shown = format!("{}:{}", broker.host, broker.port);
        let scheme = |broker: &Broker| (broker.tls, broker.path.is_some());
        if brokers.first().is_some_and(|first| scheme(first) != scheme(broker)) {
            let what = format!("{shown} uses another scheme than mqtt.url");
            reader.problem(MQTT.urls.name, what, "write the same scheme for all brokers");
        }
        if before.contains(&address) {
            let what = format!("the broker {shown} is listed twice");
            reader.problem(MQTT.urls.name, what, "remove it from urls");
        }
        before.push(address);
    }
    if brokers.len() > MOST_BROKERS {
        let what = format!("there are {} brokers, including mqtt.url", brokers.len());
        reader.problem(MQTT.urls.name, what, format!("list at most {MOST_BROKERS}"));
    }
    Some(brokers)
}

/// Reads the section; `gateway` and `state_dir` are the settings of the gateway.
pub(super) fn read(reader: &Reader<'_>, base: &Path, gateway: Option<&str>, state_dir: &Path) -> Option<Options> {
    let brokers = read_brokers(reader);
    let all = || brokers.iter().flatten();
    let tls = all().any(|broker| broker.tls);
    let client_id = MQTT.client_id.read(reader);
    let username = MQTT.username.read(reader);
    let password = read_password(reader, base);
    let proxy = MQTT.proxy.read(reader).map(|ProxyAddress { host, port }| (host, port));
    let publish_limit = MQTT.publish_limit.get(reader);
    let has = |key: &str| reader.has(key);
    if (has(MQTT.password.name) || has(MQTT.password_file.name)) && !has(MQTT.username.name) {
        reader.problem(
            MQTT.username.name,
            "there is a password without a user name",
            "write username = \"…\"",
        );
    }
    let ca = read_pem(reader, &MQTT.ca, base);
    let identity = read_identity(reader, base);
    if !tls && brokers.is_some() && (has(MQTT.ca.name) || has(MQTT.certificate.name)) {
        reader.warning(
            MQTT.url.name,
            "certificates are not used on a connection without TLS",
            "write mqtts:// or wss:// for TLS",
        );
    }
    for (place, broker) in all().enumerate().filter(|(_, broker)| broker.tls) {
        // All brokers use the gateway's own certificate.
        let identity = identity.as_ref().filter(|_| place == 0);
        check_certificates(reader, &broker.host, ca.as_deref(), identity);
    }
    for broker in all() {
        warn_of_unusual_port(reader, broker);
    }
    let topics = MQTT.base.read(reader);
    let (min_interval, max_interval) = read_publish(reader)?;
    let wanted = MQTT.topics.get(reader);
    let telemetry = Telemetry {
        state: wanted.contains(&TelemetryTopic::State),
        points: wanted.contains(&TelemetryTopic::Points),
        history: MQTT.history.get(reader),
    };
    let (telemetry_qos, event_qos) = read_qos(reader);
    let expiry = read_expiry(reader, max_interval);
    let message_expiry = Some(MQTT.message_expiry.get(reader)).filter(|expiry| !expiry.is_zero());
    let commands = MQTT.commands.get(reader);
    let require_id = MQTT.require_id.get(reader);
    let response_topics = read_response_topics(reader, topics.as_deref(), gateway);
    for broker in all().filter(|broker| !broker.tls && !broker.is_here()) {
        warn_of_clear_text(reader, &broker.host, password.is_some(), commands);
    }
    let buffer = read_buffer(reader, base);
    let home_assistant = read_home_assistant(reader);
    let retain = MQTT.retain.get(reader);
    if !retain && home_assistant.is_some() {
        reader.warning(
            MQTT.retain.name,
            "Home Assistant learns of drives by retained messages, and has none of them after it restarts",
            "leave retain out, or home_assistant",
        );
    }
    let sparkplug = read_sparkplug(reader, gateway, state_dir);
    reader.finish();
    let at = |Broker { host, port, path, .. }| drivegate_mqtt::Broker { host, port, path };
    Some(Options {
        brokers: brokers?.into_iter().map(at).collect(),
        tls,
        client_id: client_id.unwrap_or_else(|| format!("drivegate-{}", gateway.unwrap_or_default())),
        username,
        password,
        proxy,
        publish_limit,
        ca,
        identity,
        base: topics?,
        telemetry,
        telemetry_qos,
        event_qos,
        retain,
        expiry,
        message_expiry,
        min_interval,
        max_interval,
        commands,
        require_id,
        response_topics,
        principals: None,
        buffer,
        home_assistant,
        sparkplug,
    })
}

/// The discovery prefix; `home_assistant = false` has the effect of an absent table.
fn read_home_assistant(reader: &Reader<'_>) -> Option<String> {
    let off = |node| bool::from_node(node).is_ok_and(|on| !on);
    if reader.raw(MQTT.home_assistant.name).is_some_and(off) {
        return None;
    }
    let table = MQTT.home_assistant.table(reader)?;
    let prefix = MQTT_HOME_ASSISTANT.discovery_prefix.get(&table);
    table.finish();
    Some(prefix)
}

/// `password` or the text of `password_file`; a value from the environment overrides one from the file.
fn read_password(reader: &Reader<'_>, base: &Path) -> Option<Password> {
    let (plain, file) = (MQTT.password.read(reader), MQTT.password_file.read(reader));
    let [plain_from_env, file_from_env] =
        [MQTT.password.place(reader), MQTT.password_file.place(reader)].map(|p| p.env.is_some());
    let file = match (plain, file) {
        (Some(plain), None) => {
            if !plain_from_env {
                files::warn_of_readers(reader, MQTT.password.name, Path::new(reader.document().file()));
            }
            return Some(Password::Fixed(Secret(plain)));
        }
        (Some(plain), Some(_)) if plain_from_env && !file_from_env => return Some(Password::Fixed(Secret(plain))),
        (Some(_), Some(_)) if plain_from_env == file_from_env => {
            let what = "both password and password_file are set";
            reader.problem(MQTT.password.name, what, "remove one of them");
            return None;
        }
        (_, file) => file?,
    };
    let path = values::resolved(base, file);
    files::warn_of_readers(reader, MQTT.password_file.name, &path);
    reader.accept(MQTT.password_file.name, secret(&path))?;
    Some(Password::File(path))
}

/// The only line of a secret file.
pub(super) fn secret(path: &Path) -> Result<String, Finding> {
    let shown = path.display();
    Secret::read(path).map(|secret| secret.0).map_err(|fault| match fault {
        SecretFault::Unreadable(error) => files::cannot_read(path, &error),
        SecretFault::Empty => Finding::new(format!("{shown} is empty"), "write the password into it"),
        SecretFault::Lines => Finding::new(
            format!("{shown} is not a password: it has several lines"),
            "write one line",
        ),
    })
}

/// Warns about a scheme at the usual port of the other one: a broker closes such a connection, often without a word.
fn warn_of_unusual_port(reader: &Reader<'_>, broker: &Broker) {
    let (kind, remedy) = match (broker.tls, broker.path.is_some(), broker.port) {
        (false, false, 8883) => ("with TLS", "write mqtts://"),
        (true, false, 1883) => ("without TLS", "write port 8883, or mqtt:// for a broker without TLS"),
        (false, true, 443) => ("with TLS", "write wss://"),
        (true, true, 80) => ("without TLS", "write port 443, or ws:// for a broker without TLS"),
        _ => return,
    };
    let what = format!("port {} of `{}` is usually a port {kind}", broker.port, broker.host);
    reader.warning(MQTT.url.name, what, remedy);
}

/// Warns about passwords and commands that others on the way to the broker could read or alter.
fn warn_of_clear_text(reader: &Reader<'_>, host: &str, password: bool, commands: bool) {
    let remedy = "write mqtts:// for TLS";
    if password {
        let what = format!("the password is sent to `{host}` in clear text");
        reader.warning(MQTT.url.name, what, remedy);
    }
    if commands {
        let what = format!(
            "commands come from `{host}` without TLS: anyone who can alter them in transit commands the drives"
        );
        reader.warning(MQTT.commands.name, what, remedy);
    }
}

/// Whether the certificates are valid and of use for the broker at `host`, and whether the key is that of its certificate.
fn check_certificates(reader: &Reader<'_>, host: &str, ca: Option<&Path>, identity: Option<&(PathBuf, PathBuf)>) {
    if let Some(ca) = ca.filter(|ca| is_readable(ca)) {
        files::check_certificates(reader, MQTT.ca.name, ca, host);
    }
    if let Some((certificate, key)) = identity.filter(|(certificate, key)| is_readable(certificate) && is_readable(key))
    {
        files::warn_of_readers(reader, MQTT.key.name, key);
        let loaded = ServerIdentity::load_of_client(certificate, key, SystemTime::now());
        let _ = files::reported(reader, loaded, |file| match file {
            TlsFile::Key => MQTT.key.name,
            _ => MQTT.certificate.name,
        });
    }
}

/// Whether the file can be read; [`read_pem`] has reported a file that cannot.
fn is_readable(path: &Path) -> bool {
    path.is_file() && File::open(path).is_ok()
}

/// Path of a PEM file that can be read now.
fn read_pem(reader: &Reader<'_>, key: &Key<PathBuf>, base: &Path) -> Option<PathBuf> {
    let path = values::resolved(base, key.read(reader)?);
    let readable = File::open(&path).and_then(|file| {
        if file.metadata()?.is_file() {
            Ok(())
        } else {
            Err(std::io::Error::other("not a file"))
        }
    });
    reader.accept(key.name, readable.map_err(|error| files::cannot_read(&path, &error)));
    Some(path)
}

fn read_identity(reader: &Reader<'_>, base: &Path) -> Option<(PathBuf, PathBuf)> {
    let certificate = read_pem(reader, &MQTT.certificate, base);
    let key = read_pem(reader, &MQTT.key, base);
    values::both_or_none(reader, [MQTT.certificate.name, MQTT.key.name]);
    Some((certificate?, key?))
}

fn read_qos(reader: &Reader<'_>) -> (Qos, Qos) {
    let qos = |level: u8| if level == 0 { Qos::AtMostOnce } else { Qos::AtLeastOnce };
    let Some(table) = MQTT.qos.table(reader) else {
        return (Qos::AtMostOnce, Qos::AtLeastOnce);
    };
    let levels = (MQTT_QOS.telemetry.get(&table), MQTT_QOS.events.get(&table));
    table.finish();
    (qos(levels.0), qos(levels.1))
}

fn read_expiry(reader: &Reader<'_>, max_interval: Duration) -> Option<Duration> {
    let expiry = Some(MQTT.expiry.get(reader)).filter(|expiry| !expiry.is_zero())?;
    if expiry <= max_interval {
        let [expiry, max] = [expiry, max_interval].map(format_duration);
        reader.warning(
            MQTT.expiry.name,
            format!("expiry = {expiry}: an unchanged value expires before it is published again after {max}"),
            "write a longer expiry or a shorter publish.max_interval",
        );
    }
    Some(expiry)
}

fn read_response_topics(reader: &Reader<'_>, base: Option<&str>, gateway: Option<&str>) -> Vec<String> {
    let filters = MQTT.response_topics.get(reader);
    if let (Some(base), Some(gateway)) = (base, gateway) {
        let own = format!("{base}/{gateway}");
        for filter in filters
            .iter()
            .filter(|f| **f == own || f.starts_with(&format!("{own}/")))
        {
            reader.problem(
                MQTT.response_topics.name,
                format!("`{filter}` is below the gateway's own topics"),
                "write topics that no gateway uses",
            );
        }
    }
    filters
}

fn read_publish(reader: &Reader<'_>) -> Option<(Duration, Duration)> {
    let Some(table) = MQTT.publish.table(reader) else {
        return Some((
            PUBLISH.min_interval.read_default()?,
            PUBLISH.max_interval.read_default()?,
        ));
    };
    let (least, most) = (PUBLISH.min_interval.get(&table), PUBLISH.max_interval.get(&table));
    if least > most {
        let [min, max] = [least, most].map(format_duration);
        table.problem(
            PUBLISH.min_interval.name,
            format!("min_interval = {min} is longer than max_interval = {max}"),
            "swap them or raise max_interval",
        );
    }
    table.finish();
    Some((least, most))
}

fn read_buffer(reader: &Reader<'_>, base: &Path) -> Option<Buffer> {
    let table = MQTT.buffer.table(reader)?;
    let dir = BUFFER.dir.get(&table);
    let max_bytes = BUFFER.max_bytes.get(&table);
    table.finish();
    Some(Buffer {
        dir: values::resolved(base, dir),
        max_bytes,
    })
}

fn read_sparkplug(reader: &Reader<'_>, gateway: Option<&str>, state_dir: &Path) -> Option<sparkplug::Options> {
    let table = MQTT.sparkplug.table(reader)?;
    let group = SPARKPLUG.group.read(&table);
    let node = SPARKPLUG.node.read(&table);
    let primary_host = SPARKPLUG.primary_host.get(&table);
    let (alias, history) = (SPARKPLUG.alias.get(&table), SPARKPLUG.history.get(&table));
    table.finish();
    Some(sparkplug::Options {
        group: group?,
        node: node.or_else(|| gateway.map(str::to_string))?,
        primary_host,
        alias,
        history,
        state_dir: state_dir.to_path_buf(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Settings;

    #[test]
    fn brokers_are_tried_in_order_and_mistakes_named() {
        let load = |mqtt: &str| {
            let source = format!("[gateway]\nname = \"a\"\n[mqtt]\n{mqtt}\n");
            Settings::parse("a.toml", &source, std::iter::empty())
        };
        let options = load("url = \"mqtt://b1\"\nurls = [\"mqtt://b2:1884\", \"mqtt://[::1]\"]").settings;
        let options = options.unwrap().mqtt.unwrap();
        let brokers: Vec<String> = options.brokers.iter().map(ToString::to_string).collect();
        assert_eq!(brokers, ["b1:1883", "b2:1884", "[::1]:1883"]);
        assert_eq!(options.message_expiry, Some(Duration::from_secs(600)));
        let many: Vec<String> = (0..16).map(|n| format!("\"mqtt://b{n}\"")).collect();
        let many = format!("urls = [{}]", many.join(", "));
        for (mqtt, part) in [
            ("urls = [\"mqtts://b\"]", "another scheme"),
            ("urls = [\"mqtt://127.0.0.1\"]", "twice"),
            ("urls = [\"http://b\"]", "not an MQTT address"),
            ("urls = [\"mqtt://me:secret@b\"]", "contains a user"),
            (many.as_str(), "17 brokers"),
        ] {
            let errors = load(mqtt).errors;
            assert!(
                matches!(errors.as_slice(), [error] if error.to_string().contains(part)),
                "{mqtt}: {errors:?}"
            );
        }
    }

    #[test]
    fn a_scheme_at_the_usual_port_of_the_other_is_pointed_out() {
        for (url, wanted) in [
            (
                "mqtt://b:8883",
                "port 8883 of `b` is usually a port with TLS; a.toml:4, mqtt.url; write mqtts://",
            ),
            ("mqtts://b:1883", "usually a port without TLS"),
            ("ws://b:443/mqtt", "write wss://"),
            ("wss://b:80/mqtt", "write port 443, or ws://"),
            ("mqtt://b", ""),
            ("mqtts://b", ""),
            ("mqtt://b:443", ""),
            ("ws://b:8883/mqtt", ""),
        ] {
            let source = format!("[gateway]\nname = \"a\"\n[mqtt]\nurl = \"{url}\"\n");
            let warnings = Settings::parse("a.toml", &source, std::iter::empty()).warnings;
            let found: Vec<String> = warnings.iter().map(ToString::to_string).collect();
            let found = found.iter().filter(|warning| warning.contains("usually a port"));
            let found: Vec<&str> = found.map(String::as_str).collect();
            match wanted {
                "" => assert_eq!(found, [""; 0], "{url}"),
                _ => assert!(
                    matches!(found.as_slice(), [one] if one.contains(wanted)),
                    "{url}: {found:?}"
                ),
            }
        }
    }
}
