//! Options for choosing the gateway.

use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::path::{Path, PathBuf};

use super::door::Network;
use super::{Client, Door, Url};
use drivegate_gateway::config::{Settings, environment};
use drivegate_http::local::{RuntimeDirectories, SocketPath, absolute};
use drivegate_http::messages::Expected;

/// Address where `[http]` listens by default.
const USUAL: &str = "http://127.0.0.1:9488";

/// The options that select the gateway and how to reach it.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct Gateway {
    /// Configuration file of the gateway, to use its local socket [default: $DRIVEGATE_CONFIG, else
    /// /etc/drivegate/drivegate.toml].
    #[arg(long, value_name = "FILE", global = true)]
    config: Option<PathBuf>,
    /// Use the gateway's HTTP server at this address instead.
    #[arg(long, value_name = "URL", global = true, conflicts_with = "config")]
    url: Option<Url>,
    /// PEM file of the CA that signed the gateway's certificate, for https:// [default: the system's CAs].
    #[arg(long, value_name = "FILE", global = true, requires = "url")]
    ca: Option<PathBuf>,
    /// File whose only line is a token with scope `read`, or USER:PASSWORD of a user who may command.
    #[arg(long, value_name = "FILE", global = true, requires = "url")]
    token_file: Option<PathBuf>,
}

impl Gateway {
    /// Path of the configuration file.
    pub(crate) fn config(&self) -> &Path {
        self.named_config().unwrap_or_else(|| crate::default_config())
    }

    /// The configuration file that the command line or the environment names.
    fn named_config(&self) -> Option<&Path> {
        self.config.as_deref().or_else(|| crate::config_of_environment())
    }

    /// A command line with the options that this command got, so that it reaches the same gateway.
    pub(crate) fn command(&self, words: &str) -> String {
        let path = |path: &Option<PathBuf>| path.as_ref().map(|path| path.display().to_string());
        let options = [
            ("--config", path(&self.config)),
            ("--url", self.url.as_ref().map(ToString::to_string)),
            ("--ca", path(&self.ca)),
            ("--token-file", path(&self.token_file)),
        ];
        let given = options.into_iter().filter_map(|(name, value)| Some((name, value?)));
        given.fold(format!("drivegate {words}"), |line, (name, value)| {
            if value.contains(char::is_whitespace) {
                format!("{line} {name} '{value}'")
            } else {
                format!("{line} {name} {value}")
            }
        })
    }

    /// The HTTP server, if selected.
    pub(crate) fn network(&self) -> Option<Client> {
        let network = Network {
            url: self.url.clone()?,
            ca: self.ca.clone(),
            token_file: self.token_file.clone(),
        };
        Some(Client::through(Door::Network(network)))
    }

    /// A client of the gateway that runs with the configuration, which may be invalid.
    ///
    /// # Errors
    /// If the configuration gives no address at which the gateway can be reached.
    pub(crate) fn client(&self) -> Result<Client, String> {
        match self.network() {
            Some(client) => Ok(client),
            None => Client::of_configuration(self.config()),
        }
    }

    /// A client that only reads values: from any gateway that is found, unless one is specified.
    ///
    /// # Errors
    /// If the configuration gives no address at which the gateway can be reached.
    pub(crate) fn viewer(&self) -> Result<Client, String> {
        let mut client = self.client()?;
        if self.named_config().is_none() && self.url.is_none() {
            client.expected = None;
            let network = Network {
                url: USUAL.parse()?,
                ca: None,
                token_file: None,
            };
            client.doors.push(Door::Network(network));
        }
        Ok(client)
    }
}

impl Client {
    /// A client of the gateway that runs with this configuration: through its local socket or, if that is off, by HTTP.
    ///
    /// # Errors
    /// If the configuration gives no address at which the gateway can be reached.
    pub(crate) fn of_configuration(config: &Path) -> Result<Client, String> {
        let socket = Settings::socket_of(config, environment());
        let mut client = Client::for_socket(&socket, Expected::Configuration(absolute(config)));
        if socket == SocketPath::Off {
            let url = http_of(config)?;
            let (ca, token_file) = (None, None);
            client = Client::through(Door::Network(Network { url, ca, token_file }));
        }
        client.file = Some(config.to_path_buf());
        Ok(client)
    }

    /// A client of the expected gateway, at its socket.
    pub(crate) fn for_socket(socket: &SocketPath, expected: Expected) -> Client {
        let paths = socket.of_client(&RuntimeDirectories::of_this_process());
        Client {
            doors: paths.into_iter().map(Door::Socket).collect(),
            expected: Some(expected),
            file: None,
        }
    }
}

/// The URL of the HTTP server of a configuration.
fn http_of(config: &Path) -> Result<Url, String> {
    let shown = config.display();
    let settings = Settings::load(config, environment()).settings;
    let settings =
        settings.ok_or_else(|| format!("the configuration is invalid; {shown}; see `drivegate check {shown}`"))?;
    let http = settings.http.ok_or_else(|| {
        format!(
            "neither the local socket nor [http] is configured, so the gateway cannot be asked; {shown}; \
            configure one"
        )
    })?;
    if http.identity.is_some() {
        return Err(format!(
            "the HTTP server has TLS, and the name in its certificate is unknown here; {shown}; pass --url and --ca"
        ));
    }
    format!("http://{}", from_here(http.listen)).parse()
}

/// The address by which a client on this machine reaches the server.
fn from_here(listen: SocketAddr) -> SocketAddr {
    let address = match listen {
        SocketAddr::V4(at) if at.ip().is_unspecified() => Ipv4Addr::LOCALHOST.into(),
        SocketAddr::V6(at) if at.ip().is_unspecified() => Ipv6Addr::LOCALHOST.into(),
        other => other.ip(),
    };
    SocketAddr::new(address, listen.port())
}
