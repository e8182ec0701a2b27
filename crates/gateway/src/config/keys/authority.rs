//! `[authority]` and its principals.

use super::forms::*;
use drivegate_core::permit::Mode;

keys! {
    /// [Who holds a drive](commands.md#who-holds-a-drive), where several clients command it.
    AUTHORITY: AuthorityTable {
        /// `"exclusive"`: only its holder commands a drive, except stops. `"advisory"`: everything is reported, nothing
        /// refused.
        mode: Option<Mode> = Words(&[
            ("off", None), ("advisory", Some(Mode::Advisory)), ("exclusive", Some(Mode::Exclusive)),
        ]), default "off";
        /// Ranks, highest first.
        ranks: Vec<String> = List {
            parse: parse_rank, empty: Some("name at least one rank"), range: "names of ranks",
        }, default ["site", "operator", "automation", "remote"];
        /// How long a hold lasts without renewal, and how long a stop reserves the drive.
        lease: Duration = Time(Duration::from_secs(1)..=HOUR), default "30s";
        /// Whether a stop is written when a drive whose run command is set is switched to local control, so that
        /// nothing starts when it is switched back.
        stop_at_local: bool = Flag, default true;
        /// Clients that may hold drives.
        principal: Present = Own { schema: || each(PrincipalTable::schema()), range: "[[authority.principal]]" }, or "none";
    }

    /// One who may hold drives, whichever way in it uses. Rights stay what `allow`, `write`, roles and `commands` say.
    PRINCIPAL: PrincipalTable {
        /// Its name.
        name: String = Name("-_"), required;
        /// Its rank.
        rank: String = Name("-_"), required;
        /// Its addresses over Modbus TCP and TCP slots; the longest prefix counts.
        modbus_tcp: Vec<IpNet> = NETWORKS, default [];
        /// The name (CN) in its certificate, over Modbus TCP with TLS.
        certificate: String = STRING, or "none";
        /// Its user over HTTP.
        http_user: String = STRING, or "none";
        /// WHO in its MQTT topics `…/as/WHO/set`; the access rules of the broker secure them.
        mqtt: String = Name("-_"), or "none";
        /// Whether it is the Sparkplug host.
        sparkplug: bool = Flag, default false;
        /// Its addresses over BACnet; the longest prefix counts.
        bacnet: Vec<IpNet> = NETWORKS, default [];
        /// Its user name or user id at the local socket. Anyone else there has the first rank.
        socket: String = STRING, or "none";
        /// It writes its command word cyclically, as most PLCs do: a word that repeats its last stop is not a new stop. Not over HTTP and the socket.
        cyclic: bool = Flag, default false;
    }
}

fn parse_rank(text: &str) -> Result<String, Finding> {
    let is_name = |c: char| c.is_ascii_alphanumeric() || "-_".contains(c);
    if !text.is_empty() && text.len() <= 64 && text.chars().all(is_name) {
        Ok(text.to_string())
    } else {
        Err(Finding::new(
            format!("`{text}` is not a valid rank name"),
            "use letters, digits, - and _",
        ))
    }
}
