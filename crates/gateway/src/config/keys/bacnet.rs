//! `[bacnet]`.

use super::forms::*;
use drivegate_north::bacnet::WhenOffline;

/// Port of a BBMD that is written without one.
const PORT: u16 = 47808;

/// Where the objects of drives are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(in crate::config) enum Layout {
    #[default]
    Routed,
    Flat,
}

keys! {
    /// [BACnet/IP](bacnet.md) server; not started without this section. The gateway is device `device`, each drive device `device`
    /// + `unit` on a virtual network of its own.
    BACNET: Bacnet {
        /// Listen address: that of one interface, whose broadcast address is used, or `0.0.0.0`, which needs `allow`.
        listen: SocketAddr = Parsed { parse: values::socket::<PORT>, ..SOCKET }, default "127.0.0.1:47808";
        /// Device instance of the gateway; it and those of all drives must be unique in the whole BACnet network.
        device: u32 = Number(0..=4_194_302, None), default 100;
        /// `"routed"`: each drive is a device on a virtual network. `"flat"`: all objects belong to the gateway's device, with
        /// the numbers `unit * 1000 + n` and names `drive.point`, for clients that know only an address and a port.
        layout: Layout = Words(&[("routed", Layout::Routed), ("flat", Layout::Flat)]), default "routed";
        /// Number of the virtual network of the drives, unique in the whole BACnet network.
        network: u16 = Number(1..=65_534, Some((65_535, "network 65535 means all networks"))), default 1001;
        /// An offline drive: `"silent"`: does not answer; `"fault"`: answers with the flag fault.
        offline: WhenOffline = Words(&[("silent", WhenOffline::Silent), ("fault", WhenOffline::Fault)]), default "silent";
        /// Whether clients in `write` may command drives with `access = "control"`.
        commands: bool = Flag, default false;
        /// Who may read.
        allow: Vec<IpNet> = NETWORKS, default ["127.0.0.0/8"];
        /// Who may write; no one by default. BACnet has no passwords: keep it narrow.
        write: Vec<IpNet> = NETWORKS, default [];
        /// Whether `run` = inactive at priority 1 to 5 survives a restart: it refuses starts as before; nothing is
        /// written.
        keep_priorities: bool = Flag, default false;
        /// BBMD in another subnet where the gateway registers as a foreign device, to receive its broadcasts; `""`:
        /// none.
        bbmd: Option<(String, u16)> = Parsed {
            parse: parse_bbmd, words: &[], pattern: "", range: "\"host:port\", or \"\"",
        }, default "";
        /// How many devices in other subnets may register here as foreign devices, which makes the gateway a BBMD; 0: none. Not
        /// together with `bbmd`.
        foreign_devices: usize = Number(0..=64, None), default 0;
        /// Vendor identifier, registered with ASHRAE; 0 is that of ASHRAE itself.
        vendor: u16 = Number(0..=65_535, None), default 0;
        /// File whose only line is the password of DeviceCommunicationControl; without it, that service is refused.
        dcc_password_file: PathBuf = PATH, or "none";
        /// Buses whose drives are devices; `[]`: all. Units must be unique among them.
        buses: Vec<String> = List { parse: values::any_text, empty: None, range: "names of buses" }, default [];
    }
}

/// The host and port of a BBMD; none for an empty text.
fn parse_bbmd(text: &str) -> Result<Option<(String, u16)>, Finding> {
    if text.is_empty() {
        return Ok(None);
    }
    let bbmd = values::host_port(text, Some(PORT)).ok_or_else(|| {
        Finding::new(
            format!("`{text}` is not a host with a port"),
            "write for example \"192.168.1.2:47808\", or \"\" for none",
        )
    });
    bbmd.map(Some)
}
