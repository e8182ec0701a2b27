//! Searches for drives on a line: one request to each address, then the reads that distinguish families. Only reads.

use std::collections::{BTreeMap, VecDeque};
use std::io::IsTerminal;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use super::found::Found;
use super::progress::Progress;
use super::settings::{Options, Part, Setting, parts};
use super::snippet::Snippet;
use super::{values, wishes};
use crate::port_users;
use drivegate_bus::Mode;
use drivegate_bus::prober::{Answer, Prober};
use drivegate_bus::transaction::Ended;
use drivegate_core::diagnosis::signature::Shape;
use drivegate_line::{Line, LineOptions};
use drivegate_model::drive::identify::{Nameplate, PRODUCT, PRODUCT_NAME, VENDOR};
use drivegate_model::drive::profile::{Profile, Profiles};
use drivegate_model::drive::{Probe, identify};
use drivegate_proto::n2::Session;
use drivegate_proto::{Exception, LineFormat, Protocol, Reply, Request, RequestPdu, Silence, Table};

/// Bytes received during the search, apart from replies.
#[derive(Debug, Default)]
pub(crate) struct StrayBytes {
    /// Settings and addresses that were answered with invalid frames.
    pub(crate) garbage: Vec<(Setting, u8)>,
    /// Number of bytes that arrived during transactions, without echoes of requests.
    pub(crate) bytes: usize,
    /// Bytes received while no request was open.
    pub(crate) unasked: usize,
    /// Requests that the adapter sent back.
    pub(crate) echoes: usize,
    /// Number of replies that lack their beginning but are otherwise valid.
    pub(crate) start_lost: usize,
    /// Number of echoes that lack their end.
    pub(crate) cut_echoes: usize,
    /// Stray bytes directly before a reply.
    pub(crate) stray_before: usize,
    /// Replies of a gateway that no drive is at the address.
    pub(crate) no_way: usize,
    /// Number of requests sent.
    pub(crate) requests: usize,
}

/// Whether other settings are tried once a drive has answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Extent {
    /// The search ends with the first setting that works, because a line has only one.
    OneSetting,
    /// All settings were tried.
    Exhaustive,
}

/// The search on one line.
pub(crate) struct Search<'a> {
    port: &'a str,
    options: &'a Options,
    pub(crate) profiles: Profiles,
    pub(crate) found: Vec<Found>,
    pub(crate) heard: StrayBytes,
    progress: Progress,
    stop: Arc<AtomicBool>,
    /// The first values of each drive are shown; set where that is enough, and the search ends with the drives found so far.
    enough: Option<Arc<AtomicBool>>,
}

impl<'a> Search<'a> {
    pub(crate) fn new(port: &'a str, options: &'a Options, profiles: Profiles, stop: Arc<AtomicBool>) -> Search<'a> {
        Search {
            port,
            options,
            profiles,
            found: Vec::new(),
            heard: StrayBytes::default(),
            progress: Progress::new(),
            stop,
            enough: None,
        }
    }

    /// Shows the first values of each drive as soon as it is found; `enough` ends the search once there is one.
    #[must_use]
    pub(crate) fn with_values(self, enough: Arc<AtomicBool>) -> Search<'a> {
        Search {
            enough: Some(enough),
            ..self
        }
    }

    /// Listens for `time` before anything is sent, to detect another master on the line.
    ///
    /// # Errors
    /// If the port cannot be opened, or was lost.
    pub(crate) fn listen(&mut self, setting: Setting, time: Duration) -> Result<(), String> {
        let line = self.open(&setting.format)?;
        let mut prober = self.prober(&line, setting);
        // Listens in short pieces, so that a signal can end the wait.
        for _ in 0..time.as_millis() / 50 {
            if !self.stopped() {
                let heard = prober.listen_for(Duration::from_millis(50));
                heard.map_err(|lost| self.lost(&lost.to_string()))?;
            }
        }
        self.heard.unasked += prober.unasked();
        Ok(())
    }

    /// Tries all settings, in order; the progress is shown meanwhile.
    ///
    /// # Errors
    /// If the port cannot be opened, or was lost; drives found until then are kept.
    pub(crate) fn run(&mut self, settings: &[Setting], extent: Extent) -> Result<(), String> {
        let parts = parts(self.options, settings, extent == Extent::Exhaustive);
        let outcome = self.all(parts, extent);
        self.progress.end(self.is_over());
        outcome
    }

    fn all(&mut self, parts: Vec<Part>, extent: Extent) -> Result<(), String> {
        let mut waiting: VecDeque<Part> = parts.into();
        let work = |parts: &VecDeque<Part>, search: &Self| -> (usize, Duration) {
            parts
                .iter()
                .map(|part| (part.addresses.len(), search.patience(part)))
                .fold((0, Duration::ZERO), |sum, one| (sum.0 + one.0, sum.1 + one.1))
        };
        let (steps, time) = work(&waiting, self);
        self.progress.plan(steps, time);
        while let Some(part) = waiting.pop_front() {
            let before = self.found.len();
            self.one(&part)?;
            if self.is_over() {
                break;
            }
            if self.found.len() > before && extent == Extent::OneSetting {
                // The settings of the line are known, so only the remaining work with these settings is left.
                waiting.retain(|other| other.setting == part.setting);
                let (steps, time) = work(&waiting, self);
                self.progress.plan(steps, time);
            }
        }
        if extent == Extent::OneSetting && !self.stopped() {
            self.settle_format()?;
        }
        Ok(())
    }

    /// Time that the search of the addresses takes if no drive answers.
    fn patience(&self, part: &Part) -> Duration {
        let Setting { protocol, format } = part.setting;
        let silence = protocol.silence(Silence::Spec, &format);
        let one = |address: &u8| {
            Prober::patience_of(
                protocol,
                format,
                silence,
                self.timeout(protocol),
                &hello(protocol, *address),
            )
        };
        part.addresses.iter().map(one).sum::<Duration>() * self.options.tries
    }

    fn one(&mut self, part: &Part) -> Result<(), String> {
        let line = self.open(&part.setting.format)?;
        let mut prober = self.prober(&line, part.setting);
        let protocol = part.setting.protocol;
        for address in &part.addresses {
            if self.is_over() {
                break;
            }
            let at = format!("{}, address {address}", part.setting);
            let hello = hello(protocol, *address);
            self.progress.show(&at);
            let answered = self.tries(&mut prober, &hello, part.setting)?;
            self.progress.step(prober.patience(&hello) * self.options.tries);
            if answered {
                let found = self.look_closer(&mut prober, part.setting, *address)?;
                self.progress
                    .print_line(&format!("found {at}: {}", found.title(&self.profiles)));
                self.show_values(&mut prober, &found)?;
                self.found.push(found);
            }
        }
        self.heard.unasked += prober.unasked();
        Ok(())
    }

    /// Tries whether a drive answers.
    fn tries(&mut self, prober: &mut Prober<'_>, hello: &Request, setting: Setting) -> Result<bool, String> {
        for _ in 0..self.options.tries {
            match self.ask(prober, hello)?.ended {
                Ended::Reply(_) => return Ok(true),
                Ended::Silent => {}
                Ended::Corrupt(_) => {
                    // The request is repeated, because the reply may have been noise.
                    if matches!(self.ask(prober, hello)?.ended, Ended::Reply(_)) {
                        return Ok(true);
                    }
                    self.heard.garbage.push((setting, hello.address));
                }
            }
        }
        Ok(false)
    }

    fn ask(&mut self, prober: &mut Prober<'_>, request: &Request) -> Result<Answer, String> {
        let answer = prober.ask(request).map_err(|lost| self.lost(&lost.to_string()))?;
        self.heard.requests += 1;
        self.heard.bytes += answer.bytes;
        match answer.shape {
            Shape::StartLost => self.heard.start_lost += 1,
            Shape::CutEcho => self.heard.cut_echoes += 1,
            Shape::Led(_) => self.heard.stray_before += 1,
            _ => {}
        }
        self.heard.echoes += usize::from(answer.echoed);
        self.heard.no_way += usize::from(answer.no_way);
        Ok(answer)
    }

    fn lost(&self, why: &str) -> String {
        format!("{why}; {}; plug the adapter in and try again", self.port)
    }

    /// Shows the first values of a drive that was found, where they are wanted and its profile is known.
    fn show_values(&mut self, prober: &mut Prober<'_>, found: &Found) -> Result<(), String> {
        let Some(enough) = &self.enough else { return Ok(()) };
        if self.found.is_empty() {
            // A key that was pressed before there was anything to show ends nothing.
            enough.store(false, Ordering::Relaxed);
        }
        if found.profiles.is_empty() {
            return Ok(());
        }
        let snippet = Snippet {
            port: self.port,
            found: std::slice::from_ref(found),
            profiles: &self.profiles,
            profile_dirs: self.options.profile_dir.clone(),
            timeout: None,
            mode: Mode::Master,
        };
        let Some(spec) = snippet.first_drive() else {
            return Ok(());
        };
        let figures = values::read(prober, spec).map_err(|lost| self.lost(&lost.to_string()))?;
        self.progress
            .print_line(&format!("  address {}: {figures}", found.address));
        if self.found.is_empty() && std::io::stdin().is_terminal() {
            self.progress
                .print_line("looking for more drives; Enter ends the search and opens the status page");
        }
        Ok(())
    }

    /// What a device calls itself (function 43): as a stream, and by single objects where the stream lacks one.
    fn nameplate(&mut self, prober: &mut Prober<'_>, address: u8) -> Result<Nameplate, String> {
        let mut plate = Nameplate::default();
        let (stream, single) = (1, 4);
        for (code, object) in [
            (stream, VENDOR),
            (single, VENDOR),
            (single, PRODUCT),
            (single, PRODUCT_NAME),
        ] {
            if plate.get(object).is_some() {
                continue;
            }
            let request = Request::new(address, RequestPdu::DeviceIdentification { code, object });
            match self.ask(prober, &request)?.ended {
                Ended::Reply(Reply::DeviceIdentification(reply)) => plate.add(&reply),
                // Many drives lack the function; some of them do not even refuse it.
                Ended::Reply(Reply::Exception(Exception::FUNCTION)) | Ended::Silent => break,
                Ended::Reply(_) | Ended::Corrupt(_) => {}
            }
        }
        Ok(plate)
    }

    fn look_closer(&mut self, prober: &mut Prober<'_>, setting: Setting, address: u8) -> Result<Found, String> {
        let probes = identify::probes(&self.profiles, setting.protocol);
        let mut outcomes: BTreeMap<Probe, bool> = BTreeMap::new();
        let mut turnarounds: Vec<Duration> = Vec::new();
        for one in &probes {
            let request = Request::new(address, one.pdu());
            for _ in 0..self.options.tries.max(2) {
                let answer = self.ask(prober, &request)?;
                turnarounds.extend(answer.turnaround);
                match answer.ended {
                    Ended::Reply(Reply::Exception(_)) => outcomes.insert(*one, false),
                    Ended::Reply(_) => outcomes.insert(*one, true),
                    Ended::Silent | Ended::Corrupt(_) => continue,
                };
                break;
            }
        }
        turnarounds.sort_unstable();
        let mut fitting = identify::fitting(&self.profiles, setting.protocol, &outcomes);
        let mut nameplate = Nameplate::default();
        if fitting.is_empty() && setting.protocol != Protocol::N2 {
            nameplate = self.nameplate(prober, address)?;
            fitting = identify::named(&self.profiles, setting.protocol, &nameplate);
        }
        let fitting = fitting.iter().filter(|profile| profile.addresses.contains(&address));
        let mut found = Found {
            setting,
            address,
            profiles: fitting.map(|profile| profile.name.clone()).collect(),
            chosen: false,
            nameplate: nameplate.text(),
            unanswered: probes.len() - outcomes.len(),
            turnaround: turnarounds.get(turnarounds.len() / 2).copied(),
        };
        if let Some(remark) = wishes::apply(&self.options.profile, &mut found, &self.profiles) {
            self.progress.print_line(&format!("note: {remark}"));
        }
        Ok(found)
    }

    /// Settles the format of the line. Drives that expect longer characters than the format at which they answered
    /// ignore some of the requests. If the family has another usual format and all drives answer with it, that is
    /// the format of the line.
    fn settle_format(&mut self) -> Result<(), String> {
        let Some(setting) = self.found.first().map(|found| found.setting) else {
            return Ok(());
        };
        let Some(format) = better_format(&self.profiles, setting.format, &self.found) else {
            return Ok(());
        };
        let better = Setting { format, ..setting };
        let line = self.open(&format)?;
        let mut prober = self.prober(&line, better);
        for index in 0..self.found.len() {
            let Some(address) = self.found.get(index).map(|found| found.address) else {
                continue;
            };
            let hello = hello(setting.protocol, address);
            let mut answers = false;
            for _ in 0..self.options.tries.max(2) {
                answers = answers || matches!(self.ask(&mut prober, &hello)?.ended, Ended::Reply(_));
            }
            if !answers {
                return Ok(());
            }
        }
        self.progress.print_line(&format!(
            "the usual format of these drives is {}: they also reply with it",
            format.characters()
        ));
        self.found.iter_mut().for_each(|found| found.setting = better);
        Ok(())
    }

    fn open(&self, format: &LineFormat) -> Result<Line, String> {
        let opened = Line::open(self.port, format, &LineOptions::default());
        opened
            .map(|(line, _)| line)
            .map_err(|error| port_users::taken(self.port, error.to_string()))
    }

    fn prober<'l>(&self, line: &'l Line, setting: Setting) -> Prober<'l> {
        let Setting { protocol, format } = setting;
        let silence = protocol.silence(Silence::Spec, &format);
        Prober::new(line, protocol, format, silence, self.timeout(protocol))
    }

    fn timeout(&self, protocol: Protocol) -> Duration {
        self.options.timeout.unwrap_or(protocol.usual_timeout())
    }

    /// Whether the search ends here: by a signal, or because the drives found are enough.
    fn is_over(&self) -> bool {
        let enough = self
            .enough
            .as_ref()
            .is_some_and(|enough| enough.load(Ordering::Relaxed));
        self.stopped() || enough && !self.found.is_empty()
    }

    /// Whether a signal has ended the search.
    pub(crate) fn stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }
}

/// The usual format of a family found that does not list `format`, or that has one stop bit more by custom, if every other
/// family found lists it.
fn better_format(profiles: &Profiles, format: LineFormat, found: &[Found]) -> Option<LineFormat> {
    let known = |found: &Found| -> Vec<Arc<Profile>> {
        let names = found.profiles.iter();
        names.filter_map(|name| profiles.get(name).cloned()).collect()
    };
    let families: Vec<Arc<Profile>> = found.iter().flat_map(known).collect();
    let lists = |profile: &Profile, format: &String| profile.formats.is_empty() || profile.formats.contains(format);
    // A drive set to one stop bit accepts two, but not the reverse.
    let (shorter, longer) = (format.characters(), format.characters().replace("N1", "N2"));
    let is_other = |profile: &&Arc<Profile>| {
        !lists(profile, &shorter) || shorter != longer && profile.formats.first() == Some(&longer)
    };
    let other = families.iter().find(is_other)?;
    let usual = other.formats.first()?;
    families.iter().all(|profile| lists(profile, usual)).then_some(())?;
    LineFormat::new(format.baud, usual).ok()
}

/// A read that every drive answers, if only with an exception.
fn hello(protocol: Protocol, address: u8) -> Request {
    let read = RequestPdu::Read {
        table: Table::Holding,
        start: 0,
        count: 1,
    };
    let pdu = match protocol {
        Protocol::ModbusRtu | Protocol::ModbusAscii => read,
        Protocol::N2 => RequestPdu::N2(Session::Identify),
    };
    Request::new(address, pdu)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(format: &str, profiles: &[&str]) -> Found {
        let format = LineFormat::new(9600, format).unwrap();
        Found {
            setting: Setting {
                protocol: Protocol::ModbusRtu,
                format,
            },
            address: 1,
            profiles: profiles.iter().map(ToString::to_string).collect(),
            chosen: false,
            nameplate: String::new(),
            unanswered: 0,
            turnaround: None,
        }
    }

    #[test]
    fn the_usual_format_of_the_family() {
        let better = |format: &str, families: &[&[&str]]| {
            let found: Vec<Found> = families.iter().map(|names| found(format, names)).collect();
            let format = found[0].setting.format;
            better_format(&Profiles::built_in(), format, &found).map(|format| format.to_string())
        };
        let two_stop_bits = Some("9600 8N2".to_string());
        assert_eq!(better("8N1", &[&["vacon-nx"]]), None);
        assert_eq!(better("8N1", &[&["vacon-cx"]]), two_stop_bits);
        assert_eq!(better("8N1", &[&["vacon-nx"], &["vacon-cx"], &[]]), two_stop_bits);
        assert_eq!(better("8E1", &[&["vacon-cx"]]), None, "the manual lists it");
        assert_eq!(better("8N2", &[&["vacon-cx"]]), None);
        assert_eq!(better("8N2", &[&["vacon-nx"]]), None, "the manual lists it");
        assert_eq!(better("8N1", &[&[]]), None);
    }
}
