use crate::drive::PointIndex;
use std::collections::BTreeMap;
use std::sync::Arc;

use super::*;
use crate::drive::model::Quality;
use crate::drive::profile::Profiles;

fn profile(name: &str) -> Arc<Profile> {
    Profiles::built_in().get(name).unwrap().clone()
}

/// Values of a drive by point; all others are unknown.
struct Says {
    profile: Arc<Profile>,
    values: BTreeMap<PointIndex, Value>,
    order: Option<RunOrder>,
    contact: Contact,
    is_commandable: bool,
    held: Option<String>,
}

/// A drive of each family: online, ready, ordered to run at half speed, and its motor is at standstill.
fn stands(family: &str) -> Says {
    let says = Says {
        profile: profile(family),
        values: BTreeMap::new(),
        order: None,
        contact: Contact::Fresh,
        is_commandable: true,
        held: None,
    };
    let bits = [
        ("ready", true),
        ("running", false),
        ("reversed", false),
        ("fault", false),
        ("warning", false),
        ("remote", true),
        ("run", true),
        ("reverse", false),
        // Other bits of a healthy drive.
        ("hand_auto", true),
        ("hoa_on", true),
        ("reference_from_bus", true),
        ("run_from_bus", true),
    ];
    let says = bits
        .into_iter()
        .fold(says, |says, (point, state)| says.with(point, Value::Bool(state)));
    let figures = [("output_frequency", 0.0), ("dc_link_voltage", 540.0)];
    let says = figures
        .into_iter()
        .fold(says, |says, (point, figure)| says.with(point, Value::Number(figure)));
    says.with("frequency_reference", Value::Number(25.0))
}

impl Says {
    /// This drive with another value of a point, if the family has the point.
    fn with(mut self, point: &str, value: Value) -> Says {
        if let Some(index) = self.profile.point_index(point) {
            self.values.insert(index, value);
        }
        self
    }

    fn on(self, point: &str) -> Says {
        assert!(self.profile.point_index(point).is_some(), "{point}");
        self.with(point, Value::Bool(true))
    }

    fn off(self, point: &str) -> Says {
        assert!(self.profile.point_index(point).is_some(), "{point}");
        self.with(point, Value::Bool(false))
    }

    fn ordered(mut self, run: RunWish, fate: Fate, by: Giver) -> Says {
        self.order = Some(RunOrder {
            run,
            fate,
            by,
            who: "mqtt plc".to_string(),
            text: "the text".to_string(),
            result: "not_allowed".to_string(),
            age: Duration::from_secs(12),
        });
        self
    }

    fn explain(&self) -> Explanation {
        let now = Instant::now() + Duration::from_secs(100);
        let at = now - Duration::from_millis(140);
        let sample = |index: PointIndex| match self.values.get(&index) {
            Some(value) => Sample {
                value: Some(*value),
                quality: Quality::Good,
                at: Some(at),
            },
            None => Sample::NONE,
        };
        let situation = Situation {
            now,
            contact: self.contact.clone(),
            read_at: Some(at),
            is_commandable: self.is_commandable,
            held: self.held.clone(),
            order: &|| self.order.clone(),
        };
        explain(&self.profile, &sample, &situation)
    }

    fn words(&self) -> String {
        self.explain().names().join(" ")
    }
}

const FAMILIES: [&str; 8] = [
    "vacon-nx",
    "vacon-nx-n2",
    "eaton-svx",
    "eaton-hvx",
    "eaton-hvx-n2",
    "vacon-cx",
    "teco-7300pa",
    "teco-7300pa-n2",
];

#[test]
fn every_family_tells_what_the_common_model_has() {
    for family in FAMILIES {
        let it = || stands(family);
        assert_eq!(it().words(), "not_known", "{family}");
        assert_eq!(it().off("ready").words(), "not_ready", "{family}");
        assert_eq!(
            it().on("fault").off("ready").words(),
            "fault",
            "{family}: ready follows the fault"
        );
        let uncharged = it().off("ready").with("dc_link_voltage", Value::Number(12.0));
        assert_eq!(uncharged.words(), "no_dc_link", "{family}");
        assert_eq!(it().off("run").words(), "no_run_order", "{family}");
        let zero = it().with("frequency_reference", Value::Number(0.0));
        assert_eq!(zero.words(), "reference_zero", "{family}");
        assert_eq!(it().on("reverse").words(), "direction_blocked", "{family}");
        let has_warning = it().profile.model_index(ModelPoint::Warning).is_some();
        if has_warning {
            assert_eq!(it().on("warning").words(), "warning", "{family}");
        }
        let told = it().explain().not_told;
        assert_eq!(told.contains(&"warning".to_string()), !has_warning, "{family}");
        let runs = it()
            .on("running")
            .with("output_frequency", Value::Number(25.0))
            .on("reverse");
        let explanation = runs.explain();
        assert_eq!(
            (explanation.runs, explanation.names().len()),
            (Some(true), 0),
            "{family}"
        );
    }
}

/// Table and legend of the manual contradict each other on bit 8 of the status word: the bit blocks no drive that is ready.
#[test]
fn an_uncertain_interlock_blocks_no_drive_that_is_ready() {
    let ready = stands("eaton-hvx").with("interlocked", Value::Bool(true));
    assert!(!ready.words().contains("interlocked"), "{}", ready.words());
    let unready = stands("eaton-hvx").with("interlocked", Value::Bool(true)).off("ready");
    assert!(unready.words().contains("interlocked"), "{}", unready.words());
    assert!(unready.explain().causes[0].evidence.contains("not verified"));
}

#[test]
fn what_only_some_families_tell() {
    for (family, point, state, word) in [
        ("vacon-nx", "remote", false, "local_control"),
        ("vacon-nx", "panel_control", true, "local_control"),
        ("vacon-nx", "io_control", true, "local_control"),
        ("vacon-nx", "undervoltage_stop_active", true, "undervoltage"),
        ("eaton-hvx", "bypass_active", true, "bypass"),
        ("eaton-hvx", "fire_mode_active", true, "fire_mode"),
        ("eaton-hvx", "hand_auto", false, "local_control"),
        ("eaton-hvx", "hoa_on", false, "hand_off_auto"),
        ("eaton-hvx-n2", "interlocked", true, "interlocked"),
        ("eaton-hvx-n2", "bypass_active", true, "bypass"),
        ("eaton-hvx-n2", "fire_mode_active", true, "fire_mode"),
        ("eaton-hvx-n2", "hand_auto", false, "local_control"),
        ("eaton-hvx-n2", "hoa_on", false, "hand_off_auto"),
        ("vacon-cx", "remote", false, "local_control"),
        ("teco-7300pa", "run_from_bus", false, "local_control"),
        ("teco-7300pa", "reference_from_bus", false, "local_control"),
        ("teco-7300pa", "undervoltage", true, "undervoltage"),
        ("teco-7300pa", "output_baseblock", true, "baseblock"),
        ("teco-7300pa", "reference_missing", true, "reference_missing"),
        ("teco-7300pa", "external_fault", true, "external_fault"),
        ("teco-7300pa-n2", "undervoltage", true, "undervoltage"),
        ("teco-7300pa-n2", "output_baseblock", true, "baseblock"),
        ("teco-7300pa-n2", "reference_missing", true, "reference_missing"),
        ("teco-7300pa-n2", "external_fault", true, "external_fault"),
    ] {
        let says = stands(family).with(point, Value::Bool(state));
        assert_eq!(says.words(), word, "{family} {point}");
        let cause = &says.explain().causes[0];
        assert!(cause.evidence.contains(point), "{cause:?}");
        assert!(!cause.remedy.is_empty() && cause.age_ms == Some(140), "{cause:?}");
        // A drive that this state keeps from being ready is not also reported as unready for no reason.
        let unready = stands(family).with(point, Value::Bool(state)).off("ready");
        let also = if word == "local_control" {
            "local_control not_ready"
        } else {
            word
        };
        assert_eq!(unready.words(), also, "{family} {point}");
    }
}

#[test]
fn what_became_of_the_last_order() {
    let it = |run, fate, by| stands("vacon-nx").off("run").ordered(run, fate, by).words();
    for (run, fate, by, word) in [
        (RunWish::Run, Fate::Refused, Giver::Client, "order_refused"),
        (RunWish::Run, Fate::NotSent, Giver::Client, "order_expired"),
        (RunWish::Run, Fate::Unsure, Giver::Client, "order_unanswered"),
        (RunWish::Run, Fate::Taken, Giver::Client, "other_master"),
        (RunWish::Stop, Fate::Taken, Giver::Client, "stopped_by_order"),
        (RunWish::Stop, Fate::Unsure, Giver::Supervision, "supervision"),
        (RunWish::Stop, Fate::Taken, Giver::Supervision, "supervision"),
        (RunWish::Stop, Fate::Taken, Giver::Shutdown, "stopped_by_gateway"),
        (RunWish::Stop, Fate::Taken, Giver::LocalControl, "stopped_by_gateway"),
        (RunWish::Stop, Fate::Refused, Giver::Client, "no_run_order"),
        (RunWish::Reset, Fate::Taken, Giver::Client, "fault_was_reset"),
    ] {
        assert_eq!(it(run, fate, by), word);
    }
    let refused = stands("vacon-nx")
        .off("run")
        .ordered(RunWish::Run, Fate::Refused, Giver::Client)
        .explain();
    assert_eq!(refused.causes[0].evidence, "run from mqtt plc was refused: the text");
    assert_eq!(refused.causes[0].by.as_deref(), Some("mqtt plc"));
    assert_eq!(refused.causes[0].result.as_deref(), Some("not_allowed"));
    let mut read_before = stands("vacon-nx")
        .off("run")
        .ordered(RunWish::Run, Fate::Taken, Giver::Client);
    if let Some(order) = &mut read_before.order {
        order.age = Duration::from_millis(20);
    }
    assert_eq!(
        read_before.words(),
        "no_run_order",
        "the drive was read before the order"
    );
    let mut monitored = stands("vacon-nx").off("run");
    monitored.is_commandable = false;
    assert!(monitored.explain().causes[0].remedy.contains("only monitors"));
}

#[test]
fn a_drive_that_is_held_takes_no_order() {
    let held = |mut says: Says| {
        says.held = Some("half restored".to_string());
        says
    };
    let refused = || {
        stands("vacon-nx")
            .off("run")
            .ordered(RunWish::Run, Fate::Refused, Giver::Client)
    };
    let explanation = held(refused()).explain();
    assert_eq!(explanation.names(), ["held", "order_refused"]);
    assert_eq!(explanation.causes[0].evidence, "half restored");
    let mut silent = refused();
    silent.contact = Contact::Silent;
    assert_eq!(held(silent).words(), "offline held order_refused");
    let ramps = held(stands("vacon-nx").on("running"));
    assert_eq!(ramps.explain().runs, Some(true), "it runs, whoever started it");
}

#[test]
fn a_drive_that_cannot_be_asked_tells_nothing() {
    for (contact, word) in [
        (Contact::Stale, "stale"),
        (Contact::Silent, "offline"),
        (Contact::Untried, "offline"),
        (Contact::BusDown(Some("gone".to_string())), "bus_down"),
    ] {
        let mut says = stands("vacon-nx")
            .on("fault")
            .ordered(RunWish::Run, Fate::NotSent, Giver::Client);
        says.contact = contact;
        let explanation = says.explain();
        assert_eq!(explanation.names(), [word, "order_expired"]);
        assert_eq!(explanation.runs, None);
    }
}

#[test]
fn a_fault_has_cause_and_remedy_where_the_manual_has_them() {
    let fault = |code| {
        stands("vacon-nx")
            .on("fault")
            .with("fault_code", Value::Integer(code))
            .explain()
            .causes[0]
            .clone()
    };
    let known = fault(53);
    assert_eq!(
        known.evidence,
        "fault 53: fieldbus fault (the link between master and board is broken)"
    );
    assert_eq!(known.remedy, "check the installation; then write fault_reset");
    assert!(fault(1).evidence.ends_with("fault 1: overcurrent, text not verified"));
    assert_eq!(fault(77).evidence, "fault 77, without a text in the profile");
}

#[test]
fn a_motor_that_is_enabled_at_zero_speed() {
    let says = stands("vacon-nx")
        .on("running")
        .with("frequency_reference", Value::Number(0.0));
    let explanation = says.explain();
    assert_eq!(
        (explanation.names().join(" ").as_str(), explanation.runs),
        ("reference_zero", Some(false))
    );
    let ramps = stands("vacon-nx").on("running").explain();
    assert_eq!(
        (ramps.causes.len(), ramps.runs),
        (0, Some(true)),
        "it has only begun to turn"
    );
}

#[test]
fn the_page_has_every_cause() {
    let page = include_str!("../../../../../docs/troubleshooting.md");
    for family in FAMILIES {
        for blocks in profile(family).points.iter().filter_map(|point| point.blocks.as_ref()) {
            let word = format!("`{}`", blocks.cause);
            assert!(page.contains(&word), "docs/troubleshooting.md lacks {word}");
        }
        let untold = stands(family).explain().not_told.join(", ");
        let rows = page.split_once("| family | not reported |").unwrap().1;
        let row = rows.lines().find(|row| row.contains(&format!("`{family}`"))).unwrap();
        assert!(row.ends_with(&format!("| {untold} |")), "{row}: {untold}");
    }
    let code = include_str!("../why.rs");
    let words = code
        .lines()
        .filter_map(|line| line.trim().strip_prefix('"')?.strip_suffix("\","));
    for word in words.filter(|word| word.contains('_') && !word.contains(' ')) {
        assert!(
            page.contains(&format!("| `{word}` |")),
            "docs/troubleshooting.md lacks {word}"
        );
    }
}
