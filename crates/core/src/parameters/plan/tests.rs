use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use proptest::prelude::*;

use super::super::file::Entry;
use super::super::names::Names;
use super::*;
use crate::testkit;
use drivegate_model::drive::parameters::{Limit, Parameter, ParameterList};
use drivegate_model::drive::profile::Profiles;

fn family(name: &str) -> Arc<Profile> {
    testkit::profile(name)
}

fn with_parameters() -> Vec<Arc<Profile>> {
    let all = Profiles::built_in();
    let all = all.iter().filter(|profile| !profile.parameters.is_empty());
    all.cloned().collect()
}

fn file(
    profile: &Profile,
    drive: &str,
    values: impl IntoIterator<Item = (Id, Result<RawValue, String>)>,
) -> ParameterFile {
    let entry = |value| Entry {
        value,
        note: String::new(),
    };
    let file = ParameterFile {
        drive: drive.to_string(),
        family: profile.name.clone(),
        identification: "none".to_string(),
        time: "2026-03-02T07:40:12Z".to_string(),
        values: values.into_iter().map(|(id, value)| (id, entry(value))).collect(),
        ..ParameterFile::default()
    };
    file.named(profile, &Names::default())
}

/// A parameter file with register values by id.
fn words(family: &Profile, drive: &str, values: &[(&str, u16)]) -> ParameterFile {
    let values = values.iter().map(|(id, word)| (Id::new(id), Ok(RawValue::Word(*word))));
    file(family, drive, values)
}

fn only(ids: &[&str]) -> Wishes {
    Wishes {
        only: ids.iter().map(|id| Id::new(id)).collect(),
        force: false,
    }
}

const ALL: Wishes = Wishes {
    only: Vec::new(),
    force: false,
};
const FORCED: Wishes = Wishes {
    only: Vec::new(),
    force: true,
};

fn ids_of(plan: &Plan) -> Vec<&str> {
    plan.writes.iter().map(|write| write.id.name()).collect()
}

/// Addresses of parameters that drives of this family may have: the named ones, and some without a name.
fn addresses(list: &ParameterList) -> Vec<u16> {
    let unnamed = list.spans.iter().flat_map(|span| {
        let addresses = (span.first..=span.last).step_by(97);
        addresses.filter(|address| span.numbering.id(*address).is_some())
    });
    let named = list.named.iter().map(|parameter| parameter.address);
    let all: BTreeSet<u16> = named.chain(unnamed).collect();
    all.into_iter().collect()
}

/// A value that the drive takes, made from a seed.
fn legal(profile: &Profile, parameter: Option<&Parameter>, seed: u16) -> RawValue {
    let range = parameter.and_then(|parameter| parameter.range.clone());
    if profile.parameter_words() == 2 {
        let (least, greatest) = range.map_or((0.0, 300.0), |range| (*range.start(), *range.end()));
        let value = least + (greatest - least) * f64::from(seed) / 65_535.0;
        return RawValue::Float((value as f32).to_bits());
    }
    let scale = parameter.map_or(1.0, |parameter| parameter.label.scale);
    let Some(range) = range else {
        return RawValue::Word(seed);
    };
    let counts = |value: f64| (value / scale).round() as u32;
    let (least, greatest) = (counts(*range.start()), counts(*range.end()));
    let word = least + u32::from(seed) % (greatest - least + 1);
    RawValue::Word(u16::try_from(word).unwrap_or_else(|_| panic!("{}: {parameter:?}", profile.name)))
}

type Values = BTreeMap<u16, RawValue>;

/// Legal values that keep all limits.
fn legal_values(profile: &Profile, seeds: &[u16]) -> Values {
    let list = &profile.parameters;
    let places = addresses(list);
    let values = places.iter().zip(seeds.iter().cycle());
    let mut values: Values = values
        .map(|(&address, &seed)| (address, legal(profile, list.by_address(address), seed)))
        .collect();
    make_legal(profile, &mut values);
    values
}

/// Lowers the lower value of each limit that is not kept.
fn make_legal(profile: &Profile, values: &mut Values) {
    let limits = &profile.parameters.rules.limits;
    while let Some(limit) = limits.iter().find(|limit| !keeps(values, limit)) {
        let upper = values[&limit.upper];
        values.insert(limit.lower, upper);
    }
}

fn keeps(values: &Values, limit: &Limit) -> bool {
    values[&limit.upper].number() >= values[&limit.lower].number()
}

fn keeps_all(profile: &Profile, values: &Values) -> bool {
    profile.parameters.rules.limits.iter().all(|limit| keeps(values, limit))
}

fn as_file(profile: &Profile, drive: &str, values: &Values) -> ParameterFile {
    let id = |address: &u16| Id::new(&profile.parameters.id(*address).unwrap());
    file(
        profile,
        drive,
        values.iter().map(|(address, value)| (id(address), Ok(*value))),
    )
}

/// The plan for two drives of this family, with every risk accepted.
fn forced(profile: &Profile, wanted: &Values, present: &Values) -> Plan {
    let (wanted, present) = (as_file(profile, "a", wanted), as_file(profile, "b", present));
    plan(profile, &wanted, &present, &FORCED).unwrap().0
}

/// The states that the drive passes through, including the first one.
fn states_of(plan: &Plan, present: &Values) -> Vec<Values> {
    let mut all = vec![present.clone()];
    for write in &plan.writes {
        let mut next = all[all.len() - 1].clone();
        let before = next.insert(write.address, write.to);
        assert_eq!(before, Some(write.from), "{}", write.line);
        all.push(next);
    }
    all
}

fn seeds() -> impl Strategy<Value = Vec<u16>> {
    prop::collection::vec(any::<u16>(), 211)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Property for any two legal drives: only differing values are written, each once, every step keeps the
    /// limits, and in the end only values that were left out differ. The same must hold for undoing and resuming
    /// after any step.
    #[test]
    fn every_step_is_safe_there_and_back(from in seeds(), to in seeds(), share in seeds(), cut in any::<u16>()) {
        for profile in with_parameters() {
            let (present, mut wanted) = (legal_values(&profile, &from), legal_values(&profile, &to));
            let alike: Vec<u16> = present.keys().copied().zip(&share).filter(|(_, seed)| *seed % 3 == 0).map(|(a, _)| a).collect();
            for address in alike {
                wanted.insert(address, present[&address]);
            }
            make_legal(&profile, &mut wanted);
            let plan = forced(&profile, &wanted, &present);
            let states = states_of(&plan, &present);
            for state in &states {
                prop_assert!(keeps_all(&profile, state), "{}: {plan}", profile.name);
            }
            let rules = &profile.parameters.rules;
            let written: BTreeSet<u16> = plan.writes.iter().map(|write| write.address).collect();
            prop_assert_eq!(written.len(), plan.writes.len(), "each once");
            for (address, value) in &states[states.len() - 1] {
                let held_back = rules.held_back(*address).is_some();
                prop_assert_eq!(*value == wanted[address] || held_back, true, "{} {}", profile.name, address);
                prop_assert!(written.contains(address) == (*value != present[address]));
                let left_out = plan.left_out.iter().any(|(id, _)| profile.parameters.address(id.name()) == Some(*address));
                prop_assert_eq!(left_out, *value != wanted[address]);
            }
            // The restore is undone from any step.
            let done = usize::from(cut) % (plan.writes.len() + 1);
            let back = states_of(&plan.back(done), &states[done]);
            for (state, former) in back.iter().zip(states[..=done].iter().rev()) {
                prop_assert_eq!(state, former);
            }
            prop_assert_eq!(&back[back.len() - 1], &present);
            // The plan can be resumed from any step.
            let rest = forced(&profile, &wanted, &states[done]);
            prop_assert_eq!(rest.writes.len(), plan.writes.len() - done);
            let on = states_of(&rest, &states[done]);
            prop_assert!(on.iter().all(|state| keeps_all(&profile, state)));
            prop_assert_eq!(&on[on.len() - 1], &states[states.len() - 1]);
        }
    }

    /// Property for any values and limits of two drives: every write occurs once, and a limit that holds in the end
    /// is never broken once it holds.
    #[test]
    fn no_state_is_too_odd(
        from in prop::collection::vec(0..6u16, 7),
        to in prop::collection::vec(0..6u16, 7),
        pairs in prop::collection::vec((0..7u16, 0..7u16), 0..9),
    ) {
        // Limits may form a circle; if not, the upper value is above the lower one by number, which excludes circles.
        let limit = |(upper, lower)| Limit { upper, lower };
        let any: Vec<_> = pairs.iter().copied().map(limit).collect();
        let apart = pairs.iter().filter(|(a, b)| a != b);
        let limits: Vec<_> = apart.map(|&(a, b)| limit((a.max(b), a.min(b)))).collect();
        let write = |(address, (from, to)): (u16, (&u16, &u16))| ParameterWrite {
            id: Id::new(&address.to_string()),
            address,
            from: RawValue::Word(*from),
            to: RawValue::Word(*to),
            line: String::new(),
            volatile: false,
        };
        let writes: Vec<ParameterWrite> = (0..).zip(from.iter().zip(&to)).map(write).collect();
        let present = |address: u16| from.get(usize::from(address)).copied().map(RawValue::Word);
        let ordered = order::safe(writes.clone(), &limits, present);
        for mut again in [ordered.clone(), order::safe(writes.clone(), &any, present)] {
            again.sort_by_key(|write| write.address);
            prop_assert_eq!(&again, &writes);
        }
        let holds = |limit: &Limit, state: &[u16]| {
            state[usize::from(limit.upper)] >= state[usize::from(limit.lower)]
        };
        let mut state = from.clone();
        for write in &ordered {
            let before = state.clone();
            state[usize::from(write.address)] = to[usize::from(write.address)];
            for limit in limits.iter().filter(|limit| holds(limit, &to)) {
                prop_assert!(holds(limit, &state) || !holds(limit, &before));
            }
        }
    }
}

#[test]
fn a_maximum_rises_before_and_falls_after_what_it_limits() {
    let nx = family("vacon-nx");
    let low = words(
        &nx,
        "pump-1",
        &[("101", 1000), ("102", 5000), ("103", 30), ("105", 4000)],
    );
    let high = words(
        &nx,
        "pump-1",
        &[("101", 6000), ("102", 10_000), ("103", 20), ("105", 9000)],
    );
    let up = plan(&nx, &high, &low, &ALL).unwrap().0;
    assert_eq!(ids_of(&up), ["102", "101", "103", "105"]);
    assert_eq!(
        up.writes[0].line,
        "102 Maximum frequency: 50.00 Hz → 100.00 Hz (5000 → 10000)"
    );
    let down = plan(&nx, &low, &high, &ALL).unwrap().0;
    assert_eq!(ids_of(&down), ["101", "103", "105", "102"]);
    assert_eq!(ids_of(&up.back(2)), ["101", "102"]);
    assert_eq!((up.handling, up.left_out, up.notes), Default::default());
    assert_eq!(plan(&nx, &low, &low, &ALL).unwrap(), (Plan::default(), Vec::new()));
}

#[test]
fn teco_takes_them_in_program_mode_and_saves_once() {
    let teco = family("teco-7300pa");
    let present = words(
        &teco,
        "fan-1",
        &[("Cn-02", 600), ("On-20", 0), ("Bn-01", 30), ("Sn-08", 12), ("Sn-23", 1)],
    );
    let wanted = words(
        &teco,
        "fan-1",
        &[
            ("Cn-02", 500),
            ("On-20", 7),
            ("Bn-01", 60_000),
            ("Sn-08", 15),
            ("Sn-23", 2),
        ],
    );
    let (all, risks) = plan(&teco, &wanted, &present, &ALL).unwrap();
    assert_eq!(risks, []);
    assert_eq!(ids_of(&all), ["Cn-02", "On-20", "Bn-01"]);
    assert_eq!(all.handling.save, Some((0x0900, 0)));
    let need = all.handling.needs.clone().unwrap();
    assert_eq!(teco.points.get(need.point).unwrap().name, "ready");
    assert_eq!((need.value, need.exception), (false, Some(0x22)));
    assert_eq!(
        all.to_string(),
        "3 parameters to write, in this order:\n  Cn-02 Max. Output Frequency: 60.0 Hz → 50.0 Hz (600 → 500)\n  On-20 Motor Constant R1: \
         0.000 Ohm → 0.007 Ohm (0 → 7)\n  Bn-01 Acceleration Time 1: 3.0 s → 6000.0 s (30 → 60000)\nthen 0 to register 0900H, so that \
         the drive keeps them at power-off\nleft out, although they differ; --only ID restores one:\n  Sn-08 Operation Mode \
         Selection 5: 12 → 15; source of run command and reference\n  Sn-23 Inverter station address: 1 → 2; station \
         address\nnote: the drive loses these at power-off: On-20\nfirst switch the operator to PRGM: otherwise the drive refuses some of them\n"
    );
    let ramp = plan(&teco, &wanted, &present, &only(&["Bn-01"])).unwrap().0;
    assert_eq!(
        (ids_of(&ramp), ramp.handling.needs.is_none()),
        (vec!["Bn-01"], true),
        "in any mode"
    );
    let lost = plan(&teco, &wanted, &present, &only(&["On-20"])).unwrap().0;
    assert_eq!(lost.handling.save, None, "nothing that could be kept");
    let source = plan(&teco, &wanted, &present, &only(&["Sn-08", "Sn-23"])).unwrap().0;
    assert_eq!((ids_of(&source), source.left_out.len()), (vec!["Sn-08", "Sn-23"], 0));
}

#[test]
fn drives_that_are_not_alike() {
    let (nx, teco) = (family("vacon-nx"), family("teco-7300pa"));
    let here = words(&teco, "fan-1", &[("Sn-01", 3), ("Cn-09", 22), ("Bn-01", 30)]);
    let refused = |wanted: &ParameterFile, wishes: &Wishes| plan(&teco, wanted, &here, wishes).unwrap_err();
    let of_nx = words(&nx, "pump-1", &[("102", 5000)]);
    assert_eq!(
        refused(&of_nx, &FORCED),
        [
            "the parameters of pump-1 are for the family `vacon-nx`, but the drive is of `teco-7300pa`: their parameters differ; \
          nothing can be restored"
        ]
    );
    let mut other = words(&teco, "fan-2", &[("Sn-01", 4), ("Cn-09", 44), ("Bn-01", 60)]);
    other.identification = "software_version 2".to_string();
    let reasons = refused(&other, &ALL);
    let parts = [
        "fan-1 `none`, in the file `software_version 2`",
        "the drives differ in size: Sn-01 Inverter Capacity Selection: 3 → 4",
        "ratings of supply or motor change: Cn-09 Motor Rated Current: 2.2 A → 4.4 A (22 → 44)",
    ];
    assert_eq!(reasons.len(), parts.len(), "{reasons:?}");
    for (reason, part) in reasons.iter().zip(parts) {
        assert!(
            reason.contains(part) && reason.ends_with("or take the risk with --force"),
            "{reason}"
        );
    }
    let (forced, risks) = plan(&teco, &other, &here, &FORCED).unwrap();
    assert_eq!(ids_of(&forced), ["Cn-09", "Bn-01"], "a nameplate is not copied");
    for (Risk(risk), part) in risks.iter().zip(parts) {
        assert!(risk.contains(part) && !risk.contains("--force"), "{risk}");
    }
    assert_eq!(risks.len(), 3);
    let mut unknown = [here.clone(), here.clone()];
    unknown
        .iter_mut()
        .for_each(|file| file.identification = "software_version not known".to_string());
    let reasons = plan(&teco, &unknown[0], &unknown[1], &ALL).unwrap_err();
    assert!(
        reasons[0].starts_with("whether the drives are of the same kind is unknown"),
        "{reasons:?}"
    );
    // The file comes from the drive itself, so the motor connected to it is unchanged.
    let own = words(&teco, "fan-1", &[("Sn-01", 3), ("Cn-09", 44), ("Bn-01", 30)]);
    let (plan_of_own, risks) = plan(&teco, &own, &here, &ALL).unwrap();
    assert_eq!(
        (ids_of(&plan_of_own), risks.len(), plan_of_own.notes.len()),
        (vec!["Cn-09"], 0, 1)
    );
    // A parameter that is requested by name is restored although it is left out by default.
    let current = words(&teco, "fan-2", &[("Sn-01", 3), ("Cn-09", 44), ("Bn-01", 30)]);
    assert_eq!(
        ids_of(&plan(&teco, &current, &here, &only(&["Cn-09"])).unwrap().0),
        ["Cn-09"]
    );
    let unread = file(&teco, "fan-1", [(Id::new("Sn-01"), Err("no answer".to_string()))]);
    assert!(
        refused(&unread, &ALL)
            .iter()
            .any(|reason| reason.contains("Sn-01 was not read from both"))
    );
}

#[test]
fn parameters_without_a_name_go_to_the_same_application_only() {
    let cx = family("vacon-cx");
    let here = words(&cx, "a", &[("0.1", 0), ("1.2", 50), ("2.5", 1)]);
    let same = words(&cx, "b", &[("0.1", 3), ("1.2", 60), ("2.5", 2)]);
    let (all, _) = plan(&cx, &same, &here, &ALL).unwrap();
    assert_eq!(ids_of(&all), ["1.2", "2.5"]);
    assert_eq!(all.left_out.len(), 1, "{all}");
    assert!(
        all.notes[0].starts_with("the profile has no name for 2.5: any of them"),
        "{all}"
    );
    let other = words(&cx, "b", &[("0.1", 3), ("1.2", 60), ("2.5", 2), ("2.6", 2)]);
    assert!(plan(&cx, &other, &here, &ALL).unwrap_err()[0].contains("application, size or software differs"));
    let (forced, risks) = plan(&cx, &other, &here, &FORCED).unwrap();
    assert_eq!((ids_of(&forced), risks.len()), (vec!["1.2"], 1));
    assert!(forced.left_out[1].1.contains("it has no name"), "{forced}");
    let named = Wishes {
        force: true,
        ..only(&["2.5"])
    };
    assert_eq!(ids_of(&plan(&cx, &other, &here, &named).unwrap().0), ["2.5"]);
}

#[test]
fn what_is_missing_or_not_legal() {
    let nx = family("vacon-nx");
    let word = |word| Ok(RawValue::Word(word));
    let not = |why: &str| Err(why.to_string());
    let entries = |values: Vec<(&str, Result<RawValue, String>)>| {
        let values: Vec<_> = values.into_iter().map(|(id, value)| (Id::new(id), value)).collect();
        values
    };
    let here = file(
        &nx,
        "a",
        entries(vec![
            ("101", word(0)),
            ("102", word(1)),
            ("103", not("busy")),
            ("733", word(0)),
        ]),
    );
    let there = file(
        &nx,
        "a",
        entries(vec![
            ("101", not("busy")),
            ("102", word(2)),
            ("103", word(9)),
            ("733", word(4)),
        ]),
    );
    let (all, _) = plan(&nx, &there, &here, &ALL).unwrap();
    assert_eq!(ids_of(&all), ["102"]);
    assert_eq!(
        all.notes,
        [
            "left as they are, not read when the file was made: 101",
            "left as they are, not read from the drive now: 103"
        ]
    );
    let refused = |wishes: &Wishes| plan(&nx, &there, &here, wishes).unwrap_err();
    let outside = refused(&only(&["733"]));
    assert!(
        outside[0].contains("733 Response to fieldbus fault: 0 → 4 (0 → 4): outside")
            || outside[0].contains("outside the drive's range, 0 to 3"),
        "{outside:?}"
    );
    assert_eq!(
        refused(&only(&["101", "103", "104"])),
        [
            "parameter 101 of the file was not read: busy; read it again",
            "parameter 103 of the drive was not read: busy; read it again",
            "the file has no parameter `104`; see `drivegate params show`",
        ]
    );
    let float = file(
        &nx,
        "a",
        entries(vec![
            ("101", word(0)),
            ("102", Ok(RawValue::Float(1))),
            ("103", word(9)),
            ("733", word(0)),
        ]),
    );
    assert!(plan(&nx, &float, &here, &FORCED).unwrap_err()[0].contains("not for this drive's family"));
    // A limit that only the mixture would break.
    let (low, high) = (
        words(&nx, "a", &[("101", 0), ("102", 50)]),
        words(&nx, "a", &[("101", 60), ("102", 100)]),
    );
    assert!(
        plan(&nx, &high, &low, &only(&["101"])).unwrap_err()[0].starts_with("102 would be below 101, which it limits")
    );
    // A limit that the drive of the file already broke may be broken again.
    let broken = words(&nx, "a", &[("101", 60), ("102", 55)]);
    let (odd, _) = plan(&nx, &broken, &low, &ALL).unwrap();
    assert_eq!(
        (ids_of(&odd).len(), odd.notes),
        (2, vec!["102 will be below 101, as it was on a".to_string()])
    );
}

#[test]
fn objects_of_n2_are_written_as_floats() {
    let teco = family("teco-7300pa-n2");
    let floats = |values: [f32; 3]| {
        let ids = ["AO 4", "AO 13", "AO 21"];
        let values = ids.into_iter().zip(values);
        file(
            &teco,
            "a",
            values.map(|(id, value)| (Id::new(id), Ok(RawValue::Float(value.to_bits())))),
        )
    };
    let (here, there) = (floats([0.0, 100.0, 1.0]), floats([-0.0, 90.5, 2.0]));
    let (all, _) = plan(&teco, &there, &here, &ALL).unwrap();
    assert_eq!(
        all.writes[0].line,
        "AO 13 Frequency command upper bound: 100 % → 90.5 %"
    );
    assert_eq!((ids_of(&all), all.writes[0].address), (vec!["AO 13"], 24));
    assert_eq!(all.handling.needs.map(|need| need.exception), Some(Some(0x91)));
    assert_eq!((all.handling.save, all.left_out.len(), all.notes.len()), (None, 1, 1));
    let beyond = floats([180.5, 100.0, 1.0]);
    assert!(plan(&teco, &beyond, &here, &FORCED).unwrap_err()[0].contains("0 to 180"));
}
