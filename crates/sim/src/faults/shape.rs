//! The bytes on the line when a fault occurs.

use std::time::Duration;

use super::{Fault, FaultPlan, Foreign};
use crate::framing;
use crate::random::Random;
use drivegate_proto::Protocol;

impl FaultPlan {
    /// The bytes that appear on the line for `reply` to `request` under a fault, in order.
    pub fn shape(
        &mut self,
        fault: Option<Fault>,
        protocol: Protocol,
        request: &[u8],
        reply: Vec<u8>,
        silence: Duration,
    ) -> Vec<Burst> {
        let random = &mut self.random;
        let burst = |bytes| Burst {
            gap: Duration::ZERO,
            bytes,
            kind: Kind::Regular,
        };
        let provoked = |bytes| Burst {
            kind: Kind::Provoked,
            ..burst(bytes)
        };
        match fault {
            // The character that the mains hit is only determined on the line.
            None | Some(Fault::Exception(_) | Fault::Mains(_)) => vec![burst(reply)],
            Some(Fault::Deaf | Fault::Drop | Fault::CutRequest | Fault::NeedsPause(_)) => Vec::new(),
            Some(Fault::Truncate) => vec![burst(cut(reply, random))],
            Some(Fault::Corrupt) => vec![burst(corrupt(protocol, reply, random))],
            Some(Fault::Double) => vec![burst(reply.clone()), provoked(reply)],
            Some(Fault::Late(by)) => vec![Burst {
                gap: by,
                ..provoked(reply)
            }],
            Some(Fault::Foreign(what)) => vec![burst(foreign(what, protocol, &reply))],
            Some(Fault::Stray(what)) => {
                vec![
                    burst(foreign(what, protocol, &reply)),
                    Burst {
                        gap: silence,
                        ..burst(reply)
                    },
                ]
            }
            Some(Fault::Echo) => vec![
                Burst {
                    kind: Kind::Echo,
                    ..burst(request.to_vec())
                },
                burst(reply),
            ],
            Some(Fault::DeafEcho) => vec![Burst {
                kind: Kind::Echo,
                ..burst(request.to_vec())
            }],
            Some(Fault::CutEcho) => vec![Burst {
                kind: Kind::Echo,
                ..burst(request.split_last().map_or(Vec::new(), |(_, rest)| rest.to_vec()))
            }],
            Some(Fault::ReplyStart) => vec![burst(reply.get(1..).unwrap_or_default().to_vec())],
            Some(Fault::ZeroBefore) => vec![burst(vec![0]), burst(reply)],
            Some(Fault::IdleNoise) => vec![
                burst(reply),
                Burst {
                    gap: silence / 2,
                    ..provoked(vec![random.byte()])
                },
            ],
            Some(Fault::Twin) => twin(protocol, reply, random).into_iter().map(burst).collect(),
            Some(Fault::NoiseBefore) => vec![burst(noise(random)), burst(reply)],
            Some(Fault::NoiseAfter) => vec![burst(reply), provoked(noise(random))],
            Some(Fault::Split) => vec![Burst {
                kind: Kind::Split,
                ..burst(reply)
            }],
        }
    }
}

/// How a burst of bytes relates to the reply that the master expects.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// The burst occurs at the time at which the reply is expected.
    Regular,
    /// The regular reply, delivered character by character.
    Split,
    /// The master cannot foresee this burst: a request that collides with it is not the master's fault.
    Provoked,
    /// The burst appears together with the request, not after it.
    Echo,
}

/// Characters that are sent without a gap.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Burst {
    /// Time between the characters before the burst and its first character.
    pub gap: Duration,
    /// The bytes of the characters.
    pub bytes: Vec<u8>,
    /// How the burst relates to the expected reply.
    pub kind: Kind,
}

/// Two simultaneous replies: while both drives send, a low bit of either wins, and the later reply is received to its end.
fn twin(protocol: Protocol, reply: Vec<u8>, random: &mut Random) -> Vec<Vec<u8>> {
    let later = match foreign(Foreign::Data, protocol, &reply) {
        // N2 replies carry no address, so the second reply equals the first.
        none if none.is_empty() => reply.clone(),
        later => later,
    };
    let behind = random.within(1..=reply.len() as u64 + 4) as usize;
    if behind >= reply.len() {
        return vec![reply, later];
    }
    let mut both = reply;
    both.resize(behind + later.len(), 0xFF);
    both.iter_mut()
        .skip(behind)
        .zip(&later)
        .for_each(|(byte, other)| *byte &= other);
    vec![both]
}

fn cut(mut reply: Vec<u8>, random: &mut Random) -> Vec<u8> {
    let keep = random.within(1..=(reply.len() as u64).saturating_sub(1).max(1));
    reply.truncate(keep as usize);
    reply
}

/// Corrupts a reply so that it is not a valid frame of any kind.
fn corrupt(protocol: Protocol, reply: Vec<u8>, random: &mut Random) -> Vec<u8> {
    match protocol {
        Protocol::ModbusRtu | Protocol::N2 => flip(reply, random),
        Protocol::ModbusAscii => garble(reply, random),
    }
}

/// Damages one digit so that the check fails. Flipping any bit would not do: bit 5 of a letter is its case, which is
/// not an error.
fn garble(mut reply: Vec<u8>, random: &mut Random) -> Vec<u8> {
    let digits = reply.len().saturating_sub(3) as u64;
    let at = random.within(1..=digits.max(1)) as usize;
    let Some(digit) = reply.get_mut(at) else { return reply };
    match random.within(0..=2) {
        // The digit is changed, so that the LRC is wrong.
        0 => *digit = if *digit == b'0' { b'1' } else { b'0' },
        1 => *digit |= 0x80,
        // Removing one digit makes their number odd.
        _ => drop(reply.remove(at)),
    }
    reply
}

fn flip(mut reply: Vec<u8>, random: &mut Random) -> Vec<u8> {
    let at = random.within(0..=(reply.len() as u64).saturating_sub(1)) as usize;
    if let Some(byte) = reply.get_mut(at) {
        *byte ^= 1 << random.within(0..=7);
    }
    reply
}

fn noise(random: &mut Random) -> Vec<u8> {
    (0..random.within(1..=3)).map(|_| random.byte()).collect()
}

/// A valid frame that does not answer the request; its data is changed so that a test notices if a master accepts it.
pub(super) fn foreign(what: Foreign, protocol: Protocol, reply: &[u8]) -> Vec<u8> {
    let Some((address, mut pdu)) = protocol.open_frame(reply) else {
        return Vec::new();
    };
    let registers = matches!(pdu.first(), Some(3 | 4));
    pdu.iter_mut().skip(2).for_each(|byte| *byte ^= 0x55);
    let mut address = address;
    match what {
        Foreign::Data => {}
        Foreign::Address => address = if address >= 247 { 1 } else { address + 1 },
        Foreign::Function => {
            if let Some(function) = pdu.first_mut() {
                // The function of an exception is changed too: with the requested function, the frame would be an
                // answer.
                *function = if *function & 0x7F == 3 { 4 } else { 3 };
            }
            // A reply without registers becomes a reply of one register.
            if !registers {
                pdu.truncate(1);
                pdu.extend_from_slice(&[2, 0x55, 0x55]);
            }
        }
        Foreign::Length => {
            pdu.extend_from_slice(&[0x55, 0x55]);
            if let (true, Some(count)) = (registers, pdu.get_mut(1)) {
                *count = count.wrapping_add(2);
            }
        }
    }
    let mut out = Vec::new();
    framing::close(protocol, address, &pdu, &mut out);
    out
}
