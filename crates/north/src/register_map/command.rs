//! Writes to the command block.

use super::{COMMAND_WORD, FREQUENCY_REFERENCE, HEARTBEAT, HOLD, NO_I16, NO_U16, REVERSE, RUN, SPEED_REFERENCE};
use drivegate_core::order::Refusal;
use drivegate_model::drive::{ModelPoint, PointIndex, Profile, Value};

/// The bit of the command word that resets a fault.
pub(crate) const FAULT_RESET: u16 = 1 << 2;

/// The meaning of a write to the command block.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct CommandWrite {
    /// Points to set as one command: index in the profile, value in engineering units. May be empty when
    /// only the heartbeat was written.
    pub(crate) points: Vec<(PointIndex, Value)>,
    /// The word written to 0x8100, if any.
    pub(crate) word: Option<u16>,
    /// Whether the heartbeat was written.
    pub(crate) heartbeat: bool,
    /// Why everything except a stop is refused; `points` then holds the points of the stop.
    pub(crate) refused: Option<Refusal>,
}

/// The state that decides whether a write of 0x8100 resets a fault.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct CommandContext {
    /// The command word last written; `None` if none was written since the server started.
    pub(crate) word: Option<u16>,
    /// Whether the drive has a fault.
    pub(crate) fault: bool,
}

impl CommandContext {
    /// Whether `word` requests a fault reset: bit 2 changes from 0 to 1, or is set without run while the drive has
    /// a fault, whatever was written before, so that no client has to clear a bit that reads as 0. With run only
    /// the change counts, so that a client that repeats its word does not restart a motor after each fault. The
    /// first word with run after the server started does not count, since it may be such a repetition.
    pub(crate) fn resets(self, word: u16) -> bool {
        let runs = word & RUN != 0;
        let changes = self.word.map_or(!runs, |last| last & FAULT_RESET == 0);
        word & FAULT_RESET != 0 && (changes || (self.fault && !runs))
    }
}

/// Translates a write of `values` from `start` on for a drive of that family.
///
/// If one write covers both references, the one that is "not available" (0x8000, 0xFFFF) is ignored. A word without
/// run stops the drive even if the rest of the write is invalid.
///
/// # Errors
/// If an address is not writable or the family lacks it; otherwise, if a value is invalid.
pub(crate) fn command(
    profile: &Profile,
    start: u16,
    values: &[u16],
    before: CommandContext,
) -> Result<CommandWrite, Refusal> {
    understood(profile, start, values, before).or_else(|refusal| {
        let place = COMMAND_WORD.checked_sub(start).map(usize::from);
        let word = place.and_then(|place| values.get(place)).copied();
        // A word with undefined bits is not a stop.
        let stop = word.filter(|word| word & (RUN | !(RUN | REVERSE | FAULT_RESET)) == 0);
        let (Some(word), Ok(run)) = (stop, writable(profile, ModelPoint::Run)) else {
            return Err(refusal);
        };
        let mut points = vec![(run, Value::Bool(false))];
        let forward = writable(profile, ModelPoint::Reverse)
            .ok()
            .filter(|_| word & REVERSE == 0);
        points.extend(forward.map(|index| (index, Value::Bool(false))));
        Ok(CommandWrite {
            points,
            // The reset is not carried out, so its bit is not stored.
            word: Some(word & (before.word.unwrap_or_default() | !FAULT_RESET)),
            heartbeat: false,
            refused: Some(refusal),
        })
    })
}

fn understood(profile: &Profile, start: u16, values: &[u16], before: CommandContext) -> Result<CommandWrite, Refusal> {
    let both = values.len() > 1 && start <= SPEED_REFERENCE && usize::from(FREQUENCY_REFERENCE - start) < values.len();
    let writes: Vec<(u32, u16)> = (u32::from(start)..).zip(values.iter().copied()).collect();
    let outside = |a: &u32| !(u32::from(COMMAND_WORD)..=u32::from(HEARTBEAT)).contains(a);
    if let Some((address, _)) = writes.iter().find(|(a, _)| outside(a)) {
        let hint = if *address == u32::from(HOLD) {
            "; a hold (0x8104) is written alone or with 0x8103"
        } else {
            ""
        };
        return Err(Refusal::NotWritable(format!(
            "register 0x{address:04X} is not writable; commands are written to 0x8100 to 0x8103{hint}"
        )));
    }
    let mut write = CommandWrite::default();
    let mut bad = None;
    for (address, value) in writes {
        match address as u16 {
            COMMAND_WORD => {
                write.word = Some(value);
                bad = bad.or(command_word(profile, value, before, &mut write.points)?);
            }
            SPEED_REFERENCE if !(both && value == NO_I16) => {
                write.points.push((
                    writable(profile, ModelPoint::SpeedReference)?,
                    Value::Number(f64::from(value as i16) / 100.0),
                ));
                bad = bad.or((value == NO_I16).then(|| no_value(address)));
            }
            FREQUENCY_REFERENCE if !(both && value == NO_U16) => {
                write.points.push((
                    writable(profile, ModelPoint::FrequencyReference)?,
                    Value::Number(f64::from(value) / 100.0),
                ));
                bad = bad.or((value == NO_U16).then(|| no_value(address)));
            }
            HEARTBEAT => write.heartbeat = true,
            _ => {}
        }
    }
    let references = write
        .points
        .iter()
        .filter(|(_, v)| matches!(v, Value::Number(_)))
        .count();
    match bad {
        Some(refusal) => Err(refusal),
        None if references > 1 => Err(Refusal::BadValue(
            "two references in one command; write one and \"not available\" for the other; nothing was written"
                .to_string(),
        )),
        None if write.points.is_empty() && !write.heartbeat => Err(Refusal::BadValue(
            "both references are \"not available\"; nothing was written".to_string(),
        )),
        None => Ok(write),
    }
}

fn no_value(address: u32) -> Refusal {
    Refusal::BadValue(format!(
        "\"not available\" is not a valid reference for register 0x{address:04X}; nothing was written"
    ))
}

fn writable(profile: &Profile, point: ModelPoint) -> Result<PointIndex, Refusal> {
    let index = profile.model_index(point);
    let index = index.filter(|i| profile.points.get(*i).is_some_and(|p| p.write));
    index.ok_or_else(|| {
        Refusal::NotWritable(format!(
            "`{}` of profile `{}` cannot be written",
            point.name(),
            profile.name
        ))
    })
}

/// The points that the word at 0x8100 sets, or why the word is invalid.
fn command_word(
    profile: &Profile,
    word: u16,
    before: CommandContext,
    points: &mut Vec<(PointIndex, Value)>,
) -> Result<Option<Refusal>, Refusal> {
    points.push((writable(profile, ModelPoint::Run)?, Value::Bool(word & RUN != 0)));
    if word & !(RUN | REVERSE | FAULT_RESET) != 0 {
        return Ok(Some(Refusal::BadValue(format!(
            "0x{word:04X} is not a command: bits 3 to 15 must be 0; nothing was written"
        ))));
    }
    // No bit is ignored silently: a bit that the drive family lacks must be 0.
    let lacks = |refusal: Refusal| Ok(Some(Refusal::BadValue(refusal.to_string())));
    let reverse = word & REVERSE != 0;
    match writable(profile, ModelPoint::Reverse) {
        Ok(index) => points.push((index, Value::Bool(reverse))),
        Err(refusal) if reverse => return lacks(refusal),
        Err(_) => {}
    }
    if before.resets(word) {
        match writable(profile, ModelPoint::FaultReset) {
            Ok(index) => points.push((index, Value::Bool(true))),
            Err(refusal) => return lacks(refusal),
        }
    }
    Ok(None)
}
