//! Reads `[control]`: how a family is commanded.

use crate::drive::{PerPoint, PointIndex};
use std::time::Duration;

use super::super::control::{Always, Control, ControlItem, Mask, OwnWord, Run, Setting, Step, Until};
use super::super::derive::Derived;
use super::super::model::ModelPoint;
use super::super::profile::{AddressRange, Form, Point, PollClass, Raw, Source};
use super::super::refresh::REFRESH;
use super::derived::point_of;
use super::place::parse_place;
use super::ranges::Offsets;
use super::reset;
use crate::document::{Finding, Reader};
use drivegate_proto::Table;

/// Time after which a step that does not end fails.
const STEP_TIMEOUT: Duration = Duration::from_secs(2);
const LONGEST: Duration = Duration::from_secs(60);
const MOST_STEPS: usize = 8;
const MOST_STOPS: usize = 16;
/// The helper that holds the control word.
const CONTROL_WORD: &str = "control_word";

/// Parts of the profile that the table refers to.
pub(super) struct Around<'p> {
    pub(super) points: &'p PerPoint<Point>,
    pub(super) names: &'p [String],
    pub(super) ranges: &'p [AddressRange],
    pub(super) offsets: &'p Offsets,
    pub(super) update_period: Duration,
}

pub(super) fn read(reader: &Reader<'_>, around: &Around<'_>) -> Option<Control> {
    let table = reader.table("control")?;
    let at = read_at(&table, around);
    let own_word = table.parsed("own_word", |text| match text {
        "read" => Ok(OwnWord::Read),
        "shadow" => Ok(OwnWord::Shadow),
        other => Err(Finding::new(
            format!("unknown word `{other}`"),
            "write \"read\" or \"shadow\"",
        )),
    });
    let always = read_always(&table);
    let run = read_run(&table, around);
    let of = |key: &str| {
        let form = table.table(key)?;
        let setting = read_setting(&form, around);
        form.finish();
        setting
    };
    let (stop, reverse) = (of("stop"), of("reverse"));
    let also_stop = read_stops(&table, around);
    let fault_reset = reset::read(&table, around, stop);
    let restarts_on_reset = table.or("restarts_on_reset", false);
    let refresh = read_refresh(&table);
    let refresh_with = table.parsed("refresh_with", |text| match text {
        "word" => Ok(false),
        "reference" => Ok(true),
        other => Err(Finding::new(
            format!("unknown word `{other}`"),
            "write \"word\" or \"reference\"",
        )),
    });
    for key in ["run", "stop"].into_iter().filter(|key| !table.has(key)) {
        table.problem(key, format!("`{key}` is missing"), "say which word does it");
    }
    table.finish();
    let control = Control {
        at: at?,
        own_word: own_word.unwrap_or_default(),
        always,
        run: run?,
        stop: stop?,
        also_stop: also_stop?,
        reverse,
        fault_reset,
        restarts_on_reset,
        refresh,
        refresh_with_reference: refresh_with.unwrap_or_default(),
    };
    check(&table, &control);
    Some(control)
}

fn read_at(table: &Reader<'_>, around: &Around<'_>) -> Option<ControlItem> {
    let text: String = table.required("at")?;
    let place = parse_place(&text).filter(|place| matches!(place.table, Table::Holding | Table::Coil));
    let Some(ControlItem { table: kind, address }) = place else {
        table.problem(
            "at",
            format!("`{text}` is not a register or coil that can be written"),
            "write \"holding 2000\" or \"coil 0\"",
        );
        return None;
    };
    let address = around.offsets.applied(table, "at", kind, address)?;
    let writes = |range: &AddressRange| range.table == kind && range.addresses.contains(&address) && range.write > 0;
    if !around.ranges.iter().any(writes) {
        table.problem(
            "at",
            format!("{kind} {address} is in no [[range]] with `write`"),
            "add the range, or set `write` in it",
        );
    }
    Some(ControlItem { table: kind, address })
}

fn read_always(table: &Reader<'_>) -> Always {
    let Some(given) = table.table("always") else {
        return Always::default();
    };
    let bits = |key: &str| {
        let list: Vec<u8> = given.or(key, Vec::new());
        if let Some(bit) = list.iter().find(|bit| **bit > 15) {
            given.problem(
                key,
                format!("there is no bit {bit} in a word"),
                "write bits from 0 to 15",
            );
        }
        list.iter()
            .filter(|bit| **bit < 16)
            .fold(0, |word, bit| word | 1u16 << bit)
    };
    let always = Always {
        set: bits("set"),
        clear: bits("clear"),
    };
    if always.set & always.clear != 0 {
        given.problem(
            "clear",
            "a bit is in `set` and in `clear`",
            "list each bit in one of them only",
        );
    }
    given.finish();
    always
}

/// `{ bit = 0, is = 1 }` or `{ mask = 0x0F, value = 0x02 }`, with `point` and `once`.
pub(super) fn read_setting(form: &Reader<'_>, around: &Around<'_>) -> Option<Setting> {
    let place = read_place(form, around).ok()?;
    let once = form.or("once", false);
    let bits = match (form.optional::<u8>("bit"), form.optional::<u16>("mask")) {
        (Some(bit), None) if bit < 16 => {
            let is = form.or("is", 1u8);
            if is > 1 {
                form.problem("is", format!("a bit is not {is}"), "write 0 or 1");
            }
            Some((1u16 << bit, u16::from(is & 1) << bit))
        }
        (Some(bit), None) => {
            form.problem("bit", format!("there is no bit {bit} in a word"), "write 0 to 15");
            None
        }
        (None, Some(mask)) => Some((mask, form.required("value")?)),
        (Some(_), Some(_)) => {
            form.problem("mask", "a form has `bit` or `mask`, not both", "leave one of them out");
            None
        }
        (None, None) => {
            // Errors in these keys were reported already.
            if !form.has("bit") && !form.has("mask") {
                form.problem("bit", "the form names no bits", "write `bit`, or `mask` and `value`");
            }
            None
        }
    };
    let (mask, value) = bits?;
    if mask == 0 || value & !mask != 0 {
        form.problem(
            if mask == 0 { "mask" } else { "value" },
            format!("{value:#06x} is not within the mask {mask:#06x}"),
            "write a value of the bits of the mask",
        );
        return None;
    }
    Some(Setting {
        place,
        mask,
        value,
        once,
    })
}

/// `point` of a form cannot be written to, which is reported.
struct Unusable;

/// Reads the key `point` of a form; without it the form uses the control word.
fn read_place(form: &Reader<'_>, around: &Around<'_>) -> Result<Option<ControlItem>, Unusable> {
    let Some(name) = form.optional::<String>("point") else {
        return Ok(None);
    };
    let index = point_of(form, "point", &name, around.names).ok_or(Unusable)?;
    let point = around.points.get(index).ok_or(Unusable)?;
    let raw = point.raw().filter(|raw| {
        let one = matches!(raw.form, Form::U16 | Form::Bit { bit: 0, invert: false });
        point.write && one && raw.is_unscaled()
    });
    match raw {
        Some(raw) => Ok(Some(ControlItem::of(raw))),
        None => {
            form.problem(
                "point",
                format!("`{name}` is not a register or coil that is written without conversion"),
                "name a point with `write = true`, type u16 and no scale, or a coil",
            );
            Err(Unusable)
        }
    }
}

fn whole(value: u16) -> Setting {
    Setting {
        place: None,
        mask: u16::MAX,
        value,
        once: false,
    }
}

fn read_run(table: &Reader<'_>, around: &Around<'_>) -> Option<Run> {
    let form = table.table("run")?;
    let run = if form.has("steps") {
        read_steps(&form, around).map(Run::Steps)
    } else if form.has("forward_bit") || form.has("reverse_bit") {
        let bits = (form.required::<u8>("forward_bit"), form.required::<u8>("reverse_bit"));
        pair_of_bits(&form, bits, read_place(&form, around).ok()?)
    } else if form.has("forward") || form.has("reverse") {
        let (forward, reverse) = (form.required("forward"), form.required("reverse"));
        let (place, once) = (read_place(&form, around).ok()?, form.or("once", false));
        let setting = |value| Setting {
            place,
            once,
            ..whole(value)
        };
        forward.zip(reverse).map(|(forward, reverse)| Run::Pair {
            forward: setting(forward),
            reverse: setting(reverse),
        })
    } else {
        read_setting(&form, around).map(Run::One)
    };
    form.finish();
    run
}

fn pair_of_bits(form: &Reader<'_>, bits: (Option<u8>, Option<u8>), place: Option<ControlItem>) -> Option<Run> {
    let (forward, reverse) = (bits.0?, bits.1?);
    if forward > 15 || reverse > 15 || forward == reverse {
        form.problem(
            "reverse_bit",
            format!("{forward} and {reverse} are not two bits of a word"),
            "write two bits from 0 to 15",
        );
        return None;
    }
    let once = form.or("once", false);
    let mask = 1u16 << forward | 1u16 << reverse;
    let setting = |bit: u8| Setting {
        place,
        mask,
        value: 1 << bit,
        once,
    };
    Some(Run::Pair {
        forward: setting(forward),
        reverse: setting(reverse),
    })
}

pub(super) fn read_steps(form: &Reader<'_>, around: &Around<'_>) -> Option<Vec<Step>> {
    let tables = form.tables("steps");
    if tables.is_empty() || tables.len() > MOST_STEPS {
        form.problem(
            "steps",
            format!("{} steps", tables.len()),
            format!("write 1 to {MOST_STEPS}"),
        );
        return None;
    }
    let steps: Vec<Option<Step>> = tables.iter().map(|table| read_step(table, around)).collect();
    steps.into_iter().collect()
}

/// Reads `also_stop`; `None` if one of its forms is invalid. The problem is reported.
fn read_stops(table: &Reader<'_>, around: &Around<'_>) -> Option<Vec<Setting>> {
    let forms = table.tables("also_stop");
    if forms.len() > MOST_STOPS {
        table.problem(
            "also_stop",
            format!("{} forms", forms.len()),
            format!("write {MOST_STOPS} at most"),
        );
        return None;
    }
    let read = |form: &Reader<'_>| {
        let setting = read_setting(form, around);
        form.finish();
        setting
    };
    let stops: Vec<Option<Setting>> = forms.iter().map(read).collect();
    stops.into_iter().collect()
}

fn read_step(table: &Reader<'_>, around: &Around<'_>) -> Option<Step> {
    let (write, mask) = (table.required::<u16>("write"), table.or("mask", u16::MAX));
    let place = read_place(table, around);
    let until = match table.table("until") {
        Some(state) => {
            let mask = read_mask(&state, around, "is");
            state.finish();
            mask.map(Until::State)
        }
        None => Some(match read_time(table, "time") {
            Some(time) => Until::Time(time),
            None => Until::Written,
        }),
    };
    if table.has("until") && table.has("time") {
        table.problem(
            "time",
            "a step ends at a state or after a time",
            "leave one of them out",
        );
    }
    let timeout = read_time(table, "timeout").unwrap_or(STEP_TIMEOUT);
    table.finish();
    let write = write?;
    if write & !mask != 0 {
        table.problem(
            "write",
            format!("{write:#06x} is not within the mask {mask:#06x}"),
            "write a word of the bits of the mask",
        );
    }
    Some(Step {
        write: Setting {
            place: place.ok()?,
            mask,
            ..whole(write)
        },
        until: until?,
        timeout,
    })
}

pub(super) fn read_time(table: &Reader<'_>, key: &str) -> Option<Duration> {
    let time: Duration = table.optional(key)?;
    if time.is_zero() || time > LONGEST {
        table.problem(key, "the time is out of range", "write up to 60s");
    }
    Some(time.min(LONGEST))
}

/// `{ point, mask, is }`: a masked value of a register that is read.
pub(super) fn read_mask(table: &Reader<'_>, around: &Around<'_>, key: &str) -> Option<Mask> {
    let name: Option<String> = table.required("point");
    let (mask, is) = (table.required::<u32>("mask"), table.required::<u32>(key));
    let point = name.and_then(|name| Some((point_of(table, "point", &name, around.names)?, name)));
    let ((index, name), mask, is) = (point?, mask?, is?);
    let read = around.points.get(index).is_some_and(|point| {
        let plain = |raw: &Raw| matches!(raw.form, Form::U16 | Form::U32) && raw.is_unscaled();
        point.raw().is_some_and(plain) && !point.raw().is_some_and(Raw::is_bool)
    });
    if !read {
        table.problem(
            "point",
            format!("`{name}` is not a whole register"),
            "name a point of type u16 or u32 without scale, mask and equals",
        );
    } else if around
        .points
        .get(index)
        .is_some_and(|point| point.class != PollClass::Fast)
    {
        table.problem(
            "point",
            format!("`{name}` is not read fast"),
            "set class = \"fast\" there",
        );
    }
    if mask == 0 || is & !mask != 0 {
        table.problem(
            key,
            format!("{is:#06x} is not within the mask {mask:#06x}: this can never be true"),
            "write a value of the bits of the mask",
        );
    }
    Some(Mask {
        point: index,
        mask: u64::from(mask),
        is: u64::from(is),
    })
}

/// Reads `refresh`: how often ordered values are written again, if the family needs this.
fn read_refresh(table: &Reader<'_>) -> Option<Duration> {
    let key = "refresh";
    let every: Duration = table.optional(key)?;
    if !REFRESH.contains(&every) {
        table.problem(key, "the time is out of range", "write 100ms to 60s");
    }
    Some(every)
}

/// The points of the common model that follow from `[control]`, to be added after `before` other points: their
/// values are read from the control word or a separate register; a word that has another meaning when read is not
/// used. A helper point for the control word precedes them.
pub(super) fn made_points(control: &Control, points: &PerPoint<Point>, before: usize) -> Vec<Point> {
    let mut helpers: Vec<Point> = Vec::new();
    let mut index_of = |place: ControlItem| {
        let is_plain = |point: &Point| {
            point.raw().is_some_and(|raw| {
                let whole = matches!(raw.form, Form::U16 | Form::Bit { bit: 0, invert: false }) && raw.is_unscaled();
                whole && (raw.table, raw.address) == (place.table, place.address)
            })
        };
        let first = points.len() + before;
        // A register whose word cannot be read back shows something else: its point is no helper.
        let known = points
            .position(is_plain)
            .filter(|_| !control.is_unreadable(place))
            .map(PointIndex::place);
        let known = known.or_else(|| helpers.iter().position(is_plain).map(|index| first + index));
        PointIndex::new(known.unwrap_or_else(|| {
            helpers.push(helper(control, place));
            first + helpers.len() - 1
        }))
    };
    let mut state = |setting: &Setting| Mask {
        point: index_of(setting.place.unwrap_or(control.at)),
        mask: u64::from(setting.mask),
        is: u64::from(setting.value),
    };
    let reset = control.fault_reset.map(|reset| reset.setting);
    let reversed = match &control.run {
        Run::Pair { reverse, .. } => Some(*reverse),
        Run::One(_) | Run::Steps(_) => control.reverse,
    };
    let of_run = control.run_states().iter().map(&mut state).collect();
    let of_reverse = reversed.iter().map(&mut state).collect();
    let of_reset = reset.iter().map(&mut state).collect();
    let made: [(ModelPoint, Vec<Mask>); 3] = [
        (ModelPoint::Run, of_run),
        (ModelPoint::Reverse, of_reverse),
        (ModelPoint::FaultReset, of_reset),
    ];
    let made = made.into_iter().filter(|(_, any)| !any.is_empty());
    let made = made.map(|(model, any)| Point {
        write: true,
        pulse: model == ModelPoint::FaultReset,
        verified: model != ModelPoint::FaultReset || control.fault_reset.is_none_or(|reset| reset.verified),
        ..Point::of_model(model, Source::Derived(Derived::State { any }))
    });
    helpers.iter().cloned().chain(made).collect()
}

/// The control word as a hidden point, for the points that depend on it.
fn helper(control: &Control, place: ControlItem) -> Point {
    let form = match place.table {
        Table::Coil | Table::DiscreteInput => Form::Bit { bit: 0, invert: false },
        Table::Holding | Table::Input => Form::U16,
    };
    let source = Source::Raw(Raw::plain(place.table, place.address, form));
    let class = match control.own_word {
        OwnWord::Read | OwnWord::Kept => PollClass::Slow,
        OwnWord::Shadow => PollClass::Never,
    };
    Point {
        name: CONTROL_WORD.to_string(),
        model: None,
        class,
        hidden: true,
        ..Point::of_model(ModelPoint::Run, source)
    }
}

/// A contradiction is an error, and is never repaired.
fn check(table: &Reader<'_>, control: &Control) {
    for (key, what, remedy) in control.contradictions() {
        table.problem(key, what, remedy);
    }
}
