//! Through a running gateway: its Modbus TCP server, as any other client.

use std::io::{Read, Write};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpStream};
use std::time::{Duration, SystemTime};

use super::{Row, Target};
use crate::cache::DriveSpec;
use crate::codec::{Exception, Reply, RequestPdu, Table};
use crate::drive::profile::Form;
use crate::drive::{Bound, ModelPoint, Point, PollClass, Quality, Raw, Sample, Source, Value};
use crate::north::modbus_tcp::frame::{self, Header};
use crate::north::modbus_tcp::identify::{MODEL_NAME, PRODUCT_CODE, PROFILE_DIGEST, VENDOR, VENDOR_NAME, as_told};

/// Time to connect.
const CONNECT: Duration = Duration::from_millis(500);
/// Time for an answer: a command may wait for its turn, a forwarded read for a slow line.
const ANSWER: Duration = Duration::from_secs(10);
/// The gateway itself.
const GATEWAY_UNIT: u8 = 255;
/// Age of the process data, and what it is before any was read.
const AGE: u16 = 0x8002;
const NEVER: u16 = 0xFFFF;
/// The command block (`docs/modbus-tcp.md`).
const COMMAND: u16 = 0x8100;
const SPEED_REFERENCE: u16 = 0x8101;
const FREQUENCY_REFERENCE: u16 = 0x8102;
const RUN: u16 = 1 << 0;
const REVERSE: u16 = 1 << 1;
const FAULT_RESET: u16 = 1 << 2;

/// A connection to a gateway, with the drive under one unit.
#[derive(Debug)]
pub(in crate::cli) struct Remote {
    stream: TcpStream,
    address: SocketAddr,
    since: SystemTime,
    unit: u8,
    transaction: u16,
    /// Once it was asked for.
    was_read: Option<bool>,
}

/// Why a write was not done.
#[derive(Debug)]
pub(in crate::cli) enum Failure {
    /// What to tell.
    Told(String),
    /// The gateway answered with an exception, which tells the kind of reason only.
    Refused {
        /// The exception.
        code: Exception,
        /// Some of the values were written before.
        partly: bool,
    },
}

impl From<String> for Failure {
    fn from(told: String) -> Failure {
        Failure::Told(told)
    }
}

impl Remote {
    /// The gateway of the target's file, if one runs where that says.
    ///
    /// # Errors
    /// When a gateway is there that has another configuration: nothing is asked of it.
    pub(in crate::cli) fn find(target: &Target) -> Result<Option<Remote>, String> {
        for address in target.listens().into_iter().map(reachable) {
            let Some(mut remote) = Remote::connect(address) else {
                continue;
            };
            if remote.identity(VENDOR_NAME).as_deref() != Some(VENDOR) {
                continue;
            }
            return match remote.difference(target) {
                None => Ok(Some(remote)),
                Some(what) => Err(format!(
                    "{what}; {address}; the gateway there runs with another configuration: reload it, or name its file by \
                     --config"
                )),
            };
        }
        Ok(None)
    }

    /// A connection that speaks to the gateway itself.
    fn connect(address: SocketAddr) -> Option<Remote> {
        let stream = TcpStream::connect_timeout(&address, CONNECT).ok()?;
        let timeouts = stream
            .set_read_timeout(Some(ANSWER))
            .and_then(|()| stream.set_write_timeout(Some(ANSWER)))
            .and_then(|()| stream.set_nodelay(true));
        timeouts.ok()?;
        Some(Remote {
            stream,
            address,
            since: SystemTime::now(),
            unit: GATEWAY_UNIT,
            transaction: 0,
            was_read: None,
        })
    }

    /// Turns to the drive's unit and tells what the gateway has there otherwise than the file. Values are read and
    /// written by the file's profile, so that has to be the gateway's.
    fn difference(&mut self, target: &Target) -> Option<String> {
        let spec = &target.spec;
        let (unit, profile) = (spec.unit, &spec.profile);
        let gateway = self.identity(MODEL_NAME).unwrap_or_default();
        let wanted = &target.settings.gateway;
        if gateway != as_told(wanted) {
            return Some(format!("the gateway's name is `{gateway}` and `{wanted}` in the file"));
        }
        self.unit = unit;
        let Some(drive) = self.identity(MODEL_NAME) else {
            return Some(format!(
                "the gateway shows no drive under unit {unit}, the file has `{}`",
                spec.name
            ));
        };
        if drive != as_told(&spec.name) {
            return Some(format!(
                "the gateway has `{drive}` under unit {unit}, the file has `{}`",
                spec.name
            ));
        }
        let product = self.identity(PRODUCT_CODE).unwrap_or_default();
        if product != as_told(&profile.name) {
            return Some(format!(
                "the gateway has `{drive}` with the profile `{product}`, the file has it with `{}`",
                profile.name
            ));
        }
        let digest = self.identity(PROFILE_DIGEST).unwrap_or_default();
        (digest != profile.digest().to_string())
            .then(|| format!("the profile `{product}` of the gateway is not the same as that of the file"))
    }

    /// An object of the device identification.
    fn identity(&mut self, object: u8) -> Option<String> {
        let reply = self.ask(&RequestPdu::DeviceIdentification { code: 4, object }).ok()?;
        let Reply::DeviceIdentification(body) = reply else {
            return None;
        };
        let text = body.get(7..)?;
        Some(String::from_utf8_lossy(text).into_owned())
    }

    /// One request and its reply.
    fn ask(&mut self, pdu: &RequestPdu) -> Result<Reply, String> {
        let failed =
            |error: std::io::Error| format!("the gateway does not answer: {error}; {}; try again", self.address);
        self.transaction = self.transaction.wrapping_add(1);
        let header = Header {
            transaction: self.transaction,
            unit: self.unit,
        };
        let mut request = Vec::new();
        frame::encode(header, &mut request, |out| pdu.encode(out));
        self.stream.write_all(&request).map_err(failed)?;
        let strange = || format!("no Modbus TCP reply; {}; check the address", self.address);
        let mut received = Vec::new();
        loop {
            if let Some(reply) = frame::decode(&received).map_err(|_| strange())? {
                return match reply.header == header {
                    true => Reply::decode(pdu, reply.pdu)
                        .map_err(|_| format!("the reply does not fit the request; {}; try again", self.address)),
                    false => Err(strange()),
                };
            }
            let mut buffer = [0u8; 512];
            match self.stream.read(&mut buffer).map_err(failed)? {
                0 => return Err(failed(std::io::ErrorKind::UnexpectedEof.into())),
                count => received.extend(buffer.iter().take(count)),
            }
        }
    }

    /// The points with their values, each read as the drive itself numbers it.
    pub(in crate::cli) fn read(&mut self, spec: &DriveSpec, points: &[usize]) -> Result<Vec<Row>, String> {
        let mut rows = Vec::with_capacity(points.len());
        for &index in points {
            let Some(point) = spec.profile.points.get(index) else {
                continue;
            };
            let (sample, why) = self.sample(spec, point)?;
            rows.push(Row::new(point, &sample, why));
        }
        Ok(rows)
    }

    fn sample(&mut self, spec: &DriveSpec, point: &Point) -> Result<(Sample, Option<String>), String> {
        match &point.source {
            Source::Raw(raw) => self.raw(point, raw),
            Source::Derived(derived) => {
                let mut sources = Vec::new();
                let mut why = None;
                for index in derived.sources() {
                    let Some(source) = spec.profile.points.get(index) else {
                        continue;
                    };
                    let (sample, reason) = self.sample(spec, source)?;
                    why = why.or(reason);
                    sources.push(sample);
                }
                let ends = match derived.band() {
                    Some((_, low, high)) => vec![self.bound(spec, low)?, self.bound(spec, high)?],
                    None => Vec::new(),
                };
                let band = match ends.as_slice() {
                    [low, high] => low.good().zip(high.good()).map(|(l, h)| (l.as_f64(), h.as_f64())),
                    _ => None,
                };
                let qualities = sources.iter().chain(&ends).map(|sample| sample.quality);
                let sample = match qualities.fold(Quality::Good, Quality::worse) {
                    // An exception carries no value: of what is stale nothing else is known.
                    Quality::Stale => Sample {
                        quality: Quality::Stale,
                        ..Sample::NONE
                    },
                    _ => derived.sample(&sources, band),
                };
                Ok((sample, why.or(Some("its range is not known".to_string()))))
            }
        }
    }

    fn bound(&mut self, spec: &DriveSpec, bound: Bound) -> Result<Sample, String> {
        let fixed = |figure| Sample {
            value: Some(Value::Number(figure)),
            quality: Quality::Good,
            at: None,
        };
        match bound {
            Bound::Fixed(figure) => Ok(fixed(figure)),
            Bound::Point(index) => match spec.profile.points.get(index) {
                Some(point) => Ok(self.sample(spec, point)?.0),
                None => Ok(Sample::NONE),
            },
        }
    }

    fn raw(&mut self, point: &Point, raw: &Raw) -> Result<(Sample, Option<String>), String> {
        let reply = self.ask(&RequestPdu::Read {
            table: raw.table,
            start: raw.address,
            count: raw.form.items(),
        })?;
        let words = match reply {
            Reply::Registers(words) => words,
            Reply::Bits(bits) => bits.iter().map(|b| u16::from(*b)).collect(),
            Reply::Exception(code) => {
                let lost = [Exception::GATEWAY_PATH, Exception::GATEWAY_TARGET].contains(&code);
                let stale = lost && point.class != PollClass::Never && self.was_read()?;
                let quality = if stale { Quality::Stale } else { Quality::Bad };
                let sample = Sample {
                    quality,
                    ..Sample::NONE
                };
                return Ok((sample, Some(refusal(code))));
            }
            _ => return Ok((Sample::NONE, Some("the reply does not fit the request".to_string()))),
        };
        let value = raw.decode(&words, point.kind());
        let sample = Sample {
            value,
            quality: if value.is_some() { Quality::Good } else { Quality::Bad },
            at: None,
        };
        Ok((sample, Some("it is no number".to_string())))
    }

    /// Whether the gateway has values of the drive, however old: what never was read is bad and not stale.
    fn was_read(&mut self) -> Result<bool, String> {
        if self.was_read.is_none() {
            let reply = self.ask(&RequestPdu::Read {
                table: Table::Input,
                start: AGE,
                count: 1,
            })?;
            self.was_read = Some(matches!(reply, Reply::Registers(age) if age != [NEVER]));
        }
        Ok(self.was_read.unwrap_or_default())
    }

    /// Writes the points: commands of the common model as one command where the command block can hold them, other
    /// points behind them one by one. Ends at the first that is refused.
    pub(in crate::cli) fn write(&mut self, spec: &DriveSpec, values: &[(usize, Value)]) -> Result<(), Failure> {
        let mut others = Vec::new();
        let mut block = Block::default();
        for &(index, value) in values {
            let Some(point) = spec.profile.points.get(index) else {
                continue;
            };
            match point.model {
                Some(ModelPoint::Run) => block.set(RUN, value.as_bool()),
                Some(ModelPoint::Reverse) => block.set(REVERSE, value.as_bool()),
                Some(ModelPoint::FaultReset) => block.set(FAULT_RESET, value.as_bool()),
                Some(ModelPoint::SpeedReference) => block.speed = Some(count(value, point)?),
                Some(ModelPoint::FrequencyReference) => block.frequency = Some(count(value, point)?),
                _ => others.push((point, value)),
            }
        }
        let mut written = false;
        for pdu in self.block_writes(spec, &block)? {
            self.set(&pdu, &mut written)?;
        }
        for (point, value) in others {
            let raw = point.raw().filter(|_| point.write).ok_or_else(|| {
                format!(
                    "`{}` cannot be written; command line; `drivegate profiles show` tells what can",
                    point.name
                )
            })?;
            let pdu = write_of(raw, value)
                .map_err(|why| format!("`{}`: {why}; command line; nothing was written", point.name))?;
            self.set(&pdu, &mut written)?;
        }
        Ok(())
    }

    fn set(&mut self, pdu: &RequestPdu, written: &mut bool) -> Result<(), Failure> {
        let partly = std::mem::replace(written, true);
        match self.ask(pdu)? {
            Reply::Exception(code) => Err(Failure::Refused { code, partly }),
            _ => Ok(()),
        }
    }

    fn block_writes(&mut self, spec: &DriveSpec, block: &Block) -> Result<Vec<RequestPdu>, String> {
        let register = |address, value| RequestPdu::WriteRegister { address, value };
        if block.speed.is_some() && block.frequency.is_some() {
            return Err(
                "speed_reference and frequency_reference contradict each other; command line; send one of them"
                    .to_string(),
            );
        }
        let frequency = block.frequency.map(|value| register(FREQUENCY_REFERENCE, value));
        let Some((set, mask)) = block.bits else {
            return Ok(block
                .speed
                .map(|value| register(SPEED_REFERENCE, value))
                .into_iter()
                .chain(frequency)
                .collect());
        };
        let old = match mask & (RUN | REVERSE) {
            both if both == RUN | REVERSE => 0,
            // No read stands in the way of a stop.
            RUN if set & RUN == 0 => self.command_word(spec).unwrap_or(0),
            // A reset must not start a motor that stands, whatever run command is left over from before the fault.
            0 if !self.runs(spec)? => self.command_word(spec).unwrap_or(0) & !RUN,
            _ => self.command_word(spec)?,
        };
        let word = (old & !mask & (RUN | REVERSE)) | set;
        let command = match block.speed {
            Some(speed) => RequestPdu::WriteRegisters {
                start: COMMAND,
                values: vec![word, speed],
            },
            None => register(COMMAND, word),
        };
        // A stop first, a reference before a start.
        Ok(if word & RUN == 0 {
            std::iter::once(command).chain(frequency).collect()
        } else {
            frequency.into_iter().chain([command]).collect()
        })
    }

    /// Whether the motor runs, and not with a fault.
    fn runs(&mut self, spec: &DriveSpec) -> Result<bool, String> {
        let mut runs = false;
        for (point, wanted) in [(ModelPoint::Running, true), (ModelPoint::Fault, false)] {
            let Some(point) = spec.profile.model_point(point) else {
                continue;
            };
            let (sample, _) = self.sample(spec, point)?;
            runs = sample.good().is_some_and(|value| value.as_bool() == wanted);
            if !runs {
                break;
            }
        }
        Ok(runs)
    }

    /// The bits that are not commanded stay as the drive has them.
    fn command_word(&mut self, spec: &DriveSpec) -> Result<u16, String> {
        let mut word = 0;
        for (point, bit) in [(ModelPoint::Run, RUN), (ModelPoint::Reverse, REVERSE)] {
            let Some(point) = spec.profile.model_point(point) else {
                continue;
            };
            let (sample, why) = self.sample(spec, point)?;
            match sample.good() {
                Some(value) if value.as_bool() => word |= bit,
                Some(_) => {}
                None => {
                    return Err(format!(
                        "`{}` of the drive is not known: {}; {}; wait until it is, or give run and reverse both",
                        point.name,
                        why.unwrap_or_default(),
                        self.address
                    ));
                }
            }
        }
        Ok(word)
    }

    /// Where the gateway listens.
    pub(in crate::cli) fn address(&self) -> SocketAddr {
        self.address
    }

    /// As whom the gateway knows this connection, unless something translates addresses between them.
    pub(super) fn client(&self) -> Option<SocketAddr> {
        self.stream.local_addr().ok()
    }

    /// When it was opened.
    pub(super) fn since(&self) -> SystemTime {
        self.since
    }
}

/// What goes into the command block.
#[derive(Debug, Default)]
struct Block {
    /// Bits set, and which were named.
    bits: Option<(u16, u16)>,
    speed: Option<u16>,
    frequency: Option<u16>,
}

impl Block {
    fn set(&mut self, bit: u16, on: bool) {
        let (set, mask) = self.bits.unwrap_or_default();
        self.bits = Some((if on { set | bit } else { set & !bit }, mask | bit));
    }
}

/// A reference in hundredths.
fn count(value: Value, point: &Point) -> Result<u16, String> {
    let count = (value.as_f64() * 100.0).round();
    let (least, most) = match point.model {
        Some(ModelPoint::FrequencyReference) => (0.0, f64::from(u16::MAX) - 1.0),
        _ => (-32_767.0, 32_767.0),
    };
    if (least..=most).contains(&count) {
        Ok(count as i32 as u16)
    } else {
        Err(format!(
            "`{}` = {value} is out of range; command line; write {} to {}",
            point.name,
            least / 100.0,
            most / 100.0
        ))
    }
}

fn write_of(raw: &Raw, value: Value) -> Result<RequestPdu, String> {
    let words = raw.encode(value, 0).map_err(|why| why.to_string())?;
    let first = words.first().copied().unwrap_or_default();
    let merged = |mask: u16| RequestPdu::MaskWrite {
        address: raw.address,
        and_mask: !mask,
        or_mask: first,
    };
    Ok(match (raw.table, raw.form) {
        (Table::Coil, _) => RequestPdu::WriteCoil {
            address: raw.address,
            on: first != 0,
        },
        (_, Form::Bit { bit, .. }) => merged(1 << bit),
        (_, Form::Bits { first, count }) => merged((0..count).fold(0, |mask, bit| {
            mask | 1u16.checked_shl(u32::from(first + bit)).unwrap_or(0)
        })),
        _ if words.len() == 1 => RequestPdu::WriteRegister {
            address: raw.address,
            value: first,
        },
        _ => RequestPdu::WriteRegisters {
            start: raw.address,
            values: words,
        },
    })
}

/// A server that listens everywhere is reached on loopback.
pub(super) fn reachable(address: SocketAddr) -> SocketAddr {
    let ip = match address.ip() {
        IpAddr::V4(ip) if ip.is_unspecified() => IpAddr::V4(Ipv4Addr::LOCALHOST),
        IpAddr::V6(ip) if ip.is_unspecified() => IpAddr::V6(Ipv6Addr::LOCALHOST),
        ip => ip,
    };
    SocketAddr::new(ip, address.port())
}

/// An exception with what it mostly means behind a gateway (`docs/modbus-tcp.md`).
pub(in crate::cli) fn refusal(code: Exception) -> String {
    let meaning = match code {
        Exception::FUNCTION => "not allowed: the drive is only monitored, or this host is not in `write`",
        Exception::ADDRESS => "the address is read-only or the drive does not have it",
        Exception::VALUE => "the value is outside the type, the profile or the limits",
        Exception::DEVICE_FAILURE => {
            "the drive refused it with a code of its own, or its answer was garbled; the log of the gateway tells"
        }
        Exception::BUSY => "the queue is full, or another command took its place; try again",
        Exception::GATEWAY_PATH => "the bus is down",
        Exception::GATEWAY_TARGET => "the drive does not answer, or its value is stale",
        other => other.meaning(),
    };
    format!("exception {:02X} ({meaning})", code.0)
}
