//! `[http]`.

use super::forms::*;

const HOSTS: List<String> = List {
    parse: parse_host,
    empty: None,
    range: "host names or addresses, such as [\"gateway.example.com\"]",
};

keys! {
    /// HTTP server for metrics, health and the status page; not started without this section.
    HTTP: Http {
        /// Status page, metrics, health and JSON interface. Read-only without `commands`; open to everyone who can connect
        /// unless there is a `tokens_file`.
        listen: SocketAddr = Parsed { parse: values::socket::<9488>, ..SOCKET }, default "127.0.0.1:9488";
        /// Names and addresses, without a port, by which the server is reached in addition to `localhost`, the host
        /// name of this machine and its own addresses. Requests for any other [host](http.md#hosts) get 421.
        hosts: Vec<String> = HOSTS, default [];
        /// File of access [tokens](http.md#tokens), made by `drivegate token add`. With it, all paths except `/healthz`
        /// and `/readyz` require a token.
        tokens_file: PathBuf = PATH, or "none";
        /// Whether [users](commands.md#over-http) may command drives with `access = "control"`. Needs `users_file`, and
        /// `certificate` or a `listen` on the loopback.
        commands: bool = Flag, default false;
        /// File of the users who may command, made by `drivegate user add`.
        users_file: PathBuf = PATH, or "none";
        /// PEM file with the server's certificate chain, for [https](http.md#tls); needs `key`.
        certificate: PathBuf = PATH, or "none";
        /// PEM file of the certificate's private key.
        key: PathBuf = PATH, or "none";
    }
}

fn parse_host(text: &str) -> Result<String, Finding> {
    if drivegate_http::is_host(text) {
        Ok(text.to_string())
    } else {
        Err(Finding::new(
            format!("`{text}` is not a host name or an address"),
            "write it without scheme and port, such as \"gateway.example.com\"",
        ))
    }
}
