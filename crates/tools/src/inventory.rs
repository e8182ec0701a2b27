//! `drivegate inventory`: a configuration as an Ansible inventory.

use std::path::Path;

use toml::{Table, Value};

use super::failure::{Failure, Outcome};
use super::{NamedConfig, report};
use drivegate_gateway::config::{Settings, environment};
use drivegate_model::document::{self, Finding, Problem};

/// The group of all gateways, and the variable with the configuration of one.
const GROUP: &str = "drivegate";
const VARIABLE: &str = "drivegate_configuration";
/// The keys whose value is a secret, and the key that names its file instead.
const SECRETS: [([&str; 2], &str); 1] = [(["mqtt", "password"], "password_file")];
/// Beginnings of a template in a string of Ansible.
const TEMPLATES: [&str; 3] = ["{{", "{%", "{#"];

/// Prints a configuration as an Ansible inventory (YAML): the gateway as a host of group `drivegate`, the file as its variable
/// `drivegate_configuration`
///
/// The file must be valid, as for `check`. Values from the environment are not in the inventory, except the gateway's
/// name. A file containing a password is refused, because inventories are shared and kept in repositories.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  drivegate inventory plant3/pump-house.toml > inventory/pump-house.yml")]
pub(super) struct Args {
    #[command(flatten)]
    config: NamedConfig,
}

pub(super) fn run(args: &Args) -> Outcome {
    let text = inventory(args.config.path()).map_err(Failure::Invalid)?;
    Ok(report::print(&text))
}

fn inventory(path: &Path) -> Result<String, Vec<Problem>> {
    let source = document::read_file(path).map_err(|problem| vec![problem])?;
    let loaded = Settings::parse(path, &source, environment());
    let settings = loaded.settings.ok_or(loaded.errors)?;
    of(&settings.gateway, &source)
        .map_err(|(key, finding)| vec![Problem::of_file(path.display().to_string(), &key, finding)])
}

/// The inventory of the gateway `name` with the valid configuration `source`, or the key that must not be in it.
fn of(name: &str, source: &str) -> Result<String, (String, Finding)> {
    let unreadable = |what: &str| (String::new(), Finding::new(what, "write it as TOML"));
    let parsed: Result<Table, toml::de::Error> = source.parse();
    let configuration = parsed.map_err(|error| unreadable(error.message()))?;
    for ([section, key], file) in SECRETS {
        if configuration.get(section).and_then(|table| table.get(key)).is_some() {
            let what = "an inventory contains no secrets";
            let remedy = format!("write it into a file and name that with {file}");
            return Err((format!("{section}.{key}"), Finding::new(what, remedy)));
        }
    }
    let configuration = Value::Table(configuration);
    if let Some((key, text)) = template(&configuration, "") {
        let what = format!("Ansible would treat `{text}` as a template");
        return Err((key, Finding::new(what, "write it without {{, {% and {#")));
    }
    let nested = |key: &str, value| Value::Table([(key.to_string(), value)].into_iter().collect());
    let host = nested(name, nested(VARIABLE, configuration));
    // Each string stays on the line of its key.
    let options = serde_saphyr::ser_options! { prefer_block_scalars: false };
    serde_saphyr::to_string_with_options(&nested(GROUP, nested("hosts", host)), options)
        .map_err(|error| unreadable(&error.to_string()))
}

/// The first string that Ansible would take for a template, with its key.
fn template<'v>(value: &'v Value, key: &str) -> Option<(String, &'v str)> {
    match value {
        Value::String(text) if TEMPLATES.iter().any(|begin| text.contains(begin)) => Some((key.to_string(), text)),
        Value::Array(items) => {
            let mut items = items.iter().enumerate();
            items.find_map(|(index, item)| template(item, &format!("{key}[{index}]")))
        }
        Value::Table(table) => table.iter().find_map(|(name, value)| match key {
            "" => template(value, name),
            key => template(value, &format!("{key}.{name}")),
        }),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_key_with_a_secret_is_known() {
        // Collects the keys in the schema, except the keys of files.
        fn secrets(schema: &serde_json::Value, path: &str, found: &mut Vec<String>) {
            for (name, below) in schema["properties"].as_object().into_iter().flatten() {
                let path = format!("{path}.{name}");
                let secret = ["password", "secret", "token", "passphrase"];
                if secret.iter().any(|word| name.contains(word)) && !name.ends_with("_file") {
                    found.push(path.clone());
                }
                secrets(below, &path, found);
                secrets(&below["items"], &path, found);
            }
        }
        let mut found = Vec::new();
        secrets(&drivegate_gateway::config::schema(), "", &mut found);
        assert_eq!(found, SECRETS.map(|(key, _)| format!(".{}", key.join("."))));
    }

    #[test]
    fn secrets_and_templates_are_refused_with_their_key() {
        let key = |source: &str| of("a", source).unwrap_err().0;
        assert_eq!(key("[mqtt]\npassword = \"x\""), "mqtt.password");
        assert_eq!(key("mqtt = { password = \"\" }"), "mqtt.password");
        assert_eq!(
            key("[[bus]]\n[[bus.drive]]\nname = \"{{ x }}\""),
            "bus[0].drive[0].name"
        );
        assert!(of("a", "[mqtt]\npassword_file = \"/run/password\"").is_ok());
    }
}
