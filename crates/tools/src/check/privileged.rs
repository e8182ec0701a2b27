//! Whether the gateway could listen on ports that the system keeps for privileged programs.

use std::fs;
use std::net::SocketAddr;
use std::path::Path;

use drivegate_gateway::config::Settings;
use drivegate_model::document::{Finding, Problem};

/// The first port that every program may listen on, where the system does not say another.
const USUAL_FIRST: u16 = 1024;
/// Number of the capability to listen below that port, and its name in a unit.
const CAPABILITY: u32 = 10;
pub(super) const NAME: &str = "cap_net_bind_service";

/// The listeners that need the capability, unless the program that is to run has it.
pub(super) fn problems(path: &Path, settings: &Settings, capable: bool) -> Vec<Problem> {
    if capable {
        return Vec::new();
    }
    let text = fs::read_to_string("/proc/sys/net/ipv4/ip_unprivileged_port_start").unwrap_or_default();
    let first = text.trim().parse().unwrap_or(USUAL_FIRST);
    let privileged = listeners(settings)
        .into_iter()
        .filter(|(_, address)| is_privileged(*address, first));
    let problem = |(key, address): (&'static str, SocketAddr)| {
        let finding = Finding::new(
            format!(
                "a port below {first} needs a privilege that is missing here: the gateway could not listen on {address}"
            ),
            "give it CAP_NET_BIND_SERVICE (docs/installation.md, port 502), or listen on 1502 and redirect the port",
        );
        Problem::of_file(path.display().to_string(), key, finding)
    };
    privileged.map(problem).collect()
}

fn is_privileged(address: SocketAddr, first: u16) -> bool {
    (1..first).contains(&address.port())
}

/// The addresses of the TCP servers, with their keys.
fn listeners(settings: &Settings) -> Vec<(&'static str, SocketAddr)> {
    let modbus = settings.modbus_tcp.iter();
    let plain = modbus.clone().flat_map(|server| &server.listeners);
    let plain = plain
        .flat_map(|listener| &listener.listen)
        .map(|at| ("modbus_tcp.listen", *at));
    let tls = modbus.filter_map(|server| server.tls.as_ref());
    let tls = tls.flat_map(|tls| &tls.listen).map(|at| ("modbus_tcp.tls.listen", *at));
    let http = settings.http.iter().map(|http| ("http.listen", http.listen));
    plain.chain(tls).chain(http).collect()
}

/// Whether this process may listen on privileged ports: root, or a user with the capability.
pub(super) fn may() -> bool {
    has_capability(&fs::read_to_string("/proc/self/status").unwrap_or_default())
}

/// From the effective set in `/proc/self/status`, in hexadecimal.
fn has_capability(status: &str) -> bool {
    let set = status.lines().find_map(|line| line.strip_prefix("CapEff:"));
    let set = set.and_then(|set| u64::from_str_radix(set.trim(), 16).ok());
    set.is_some_and(|set| set >> CAPABILITY & 1 == 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_capability_is_that_of_the_process() {
        assert!(has_capability("Name:\tx\nCapEff:\t000001ffffffffff\n"));
        assert!(has_capability("CapEff:\t0000000000000400\n"));
        assert!(!has_capability("CapEff:\t0000000000000000\n"));
        assert!(!has_capability("CapPrm:\t0000000000000400\n"));
    }

    #[test]
    fn ports_that_the_system_keeps() {
        let is = |text: &str, first| is_privileged(text.parse().unwrap(), first);
        assert!(is("0.0.0.0:502", USUAL_FIRST) && is("[::1]:1023", USUAL_FIRST));
        assert!(!is("0.0.0.0:1502", USUAL_FIRST) && !is("0.0.0.0:0", USUAL_FIRST));
        assert!(!is("0.0.0.0:502", 0), "the system gives all ports to everybody");
        let text =
            "[gateway]\nname = \"g\"\n[modbus_tcp]\nlisten = [\"0.0.0.0:502\"]\nallow = [\"10.0.0.0/8\"]\n[http]\n";
        let settings = Settings::parse("g.toml", text, std::iter::empty()).settings.unwrap();
        let found: Vec<String> = listeners(&settings)
            .iter()
            .map(|(key, at)| format!("{key} {at}"))
            .collect();
        assert_eq!(found, ["modbus_tcp.listen 0.0.0.0:502", "http.listen 127.0.0.1:9488"]);
        assert!(problems(Path::new("g.toml"), &settings, true).is_empty());
    }
}
