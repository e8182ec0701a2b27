//! Contradictions within `[control]` of a profile. Pure.

use super::{Control, Run, Setting};
use drivegate_proto::Table;

impl Control {
    /// Contradictions: the key, the fault and the remedy.
    pub fn contradictions(&self) -> Vec<(&'static str, String, &'static str)> {
        let always = self.always;
        let mut found = Vec::new();
        let mut refuse = |key: &'static str, setting: &Setting| {
            let own = setting.place.is_none_or(|place| place == self.at);
            if own && (setting.value & always.clear != 0 || setting.mask & !setting.value & always.set != 0) {
                let what = format!("{:#06x} in {:#06x} contradicts `always`", setting.value, setting.mask);
                found.push((key, what, "leave these bits out of one of them"));
            }
        };
        self.runs().iter().for_each(|run| refuse("run", run));
        if let Run::Steps(steps) = &self.run {
            let before = steps.len().saturating_sub(1);
            steps.iter().take(before).for_each(|step| refuse("run", &step.write));
        }
        refuse("stop", &self.stop);
        self.reverse.iter().for_each(|reverse| refuse("reverse", reverse));
        let reset = self.fault_reset.map(|reset| reset.setting);
        reset.iter().for_each(|reset| refuse("fault_reset", reset));
        found.extend(self.wrong_on_coil());
        if let Some(reverse) = self.reverse.filter(|reverse| reverse.place == self.stop.place)
            && !self.stop.holds(reverse.applied(self.stop.applied(0)))
        {
            found.push((
                "reverse",
                "a direction alone takes the word of a stop away: the drive may start by it".to_string(),
                "write `run` as a pair; if the direction starts nothing, leave its bits out of `stop`",
            ));
        }
        if self.runs().iter().any(|run| run.agrees(&self.stop)) {
            found.push((
                "stop",
                "a word can be a run command and a stop at once".to_string(),
                "write bits that the run command sets differently",
            ));
        }
        found.extend(self.also_stop.iter().filter_map(|stop| self.wrong_stop(stop)));
        match &self.run {
            Run::Pair { .. } if self.reverse.is_some() => found.push((
                "reverse",
                "`run` already sets the direction".to_string(),
                "leave `reverse` out",
            )),
            Run::Pair { forward, reverse } if forward.agrees(reverse) => found.push((
                "run",
                "a word can run forward and in reverse at once".to_string(),
                "write bits that distinguish the two",
            )),
            _ => {}
        }
        if self.reverse.is_some_and(|reverse| {
            self.runs().iter().any(|run| {
                run.place == reverse.place && run.mask & reverse.mask != 0 && !matches!(self.run, Run::Steps(_))
            })
        }) {
            found.push((
                "reverse",
                "the direction shares bits with the run command".to_string(),
                "write only the bits of the direction, or `run` as a pair",
            ));
        }
        found
    }

    /// Forms on a coil, which has bit 0 only.
    fn wrong_on_coil(&self) -> Vec<(&'static str, String, &'static str)> {
        let reset = self.fault_reset.map(|reset| reset.setting);
        let steps = match &self.run {
            Run::Steps(steps) => steps.iter().map(|step| step.write).collect(),
            Run::One(_) | Run::Pair { .. } => self.runs(),
        };
        let all = steps.into_iter().map(|run| ("run", run)).chain([("stop", self.stop)]);
        let all = all.chain(self.reverse.map(|reverse| ("reverse", reverse)));
        let all = all.chain(reset.map(|reset| ("fault_reset", reset)));
        let is_coil = |setting: &Setting| setting.place.unwrap_or(self.at).table == Table::Coil;
        all.filter(|(_, setting)| is_coil(setting) && (setting.mask & 1 == 0 || setting.value > 1))
            .map(|(key, setting)| {
                let what = format!("{:#06x} in {:#06x} is not in a coil", setting.value, setting.mask);
                (key, what, "write `bit = 0`: a coil has no other")
            })
            .collect()
    }

    /// The mistake in a word that is declared as another way to stop.
    fn wrong_stop(&self, stop: &Setting) -> Option<(&'static str, String, &'static str)> {
        let key = "also_stop";
        let is = format!("{:#06x} in {:#06x}", stop.value, stop.mask);
        if stop.place.is_some() || stop.once || self.stop.place.is_some() || self.at.table != Table::Holding {
            return Some((
                key,
                format!("{is} is not in the register to which `stop` is written"),
                "write only `mask` and `value` of words of the control register",
            ));
        }
        if self.stop.mask & !stop.mask == 0 && self.stop.holds(stop.value) {
            return Some((key, format!("{is} is a stop by `stop` already"), "leave it out"));
        }
        let always = Setting {
            place: None,
            mask: self.always.set | self.always.clear,
            value: self.always.set,
            once: false,
        };
        let runs = self.runs().into_iter().filter(|run| run.place.is_none());
        let mut runs = runs.map(|run| Setting {
            mask: run.mask & !self.free(),
            value: run.value & !self.free(),
            ..run
        });
        runs.any(|run| run.agrees(stop) && always.agrees(stop)).then(|| {
            (
                key,
                format!("{is}: a run command with the bits of `always` can have that, too"),
                "write bits that `run` or `always` sets differently",
            )
        })
    }
}
