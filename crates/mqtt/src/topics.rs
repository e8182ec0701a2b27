//! Names of the topics, made and recognised.

use drivegate_core::plant::{DriveHandle, Plant};

/// The topics of one gateway.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Topics {
    /// `{base}/{gateway}`.
    root: String,
}

/// The command on a topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Target<'t> {
    /// The drive and, for a bare value, the point.
    Set(&'t str, Option<&'t str>),
    /// The hold of this drive is taken, renewed, released or broken.
    Hold(&'t str),
    /// Stop all drives.
    StopAll,
}

impl Topics {
    pub(super) fn new(base: &str, gateway: &str) -> Topics {
        Topics {
            root: format!("{base}/{gateway}"),
        }
    }

    pub(super) fn root(&self) -> &str {
        &self.root
    }

    pub(super) fn status(&self) -> String {
        format!("{}/status", self.root)
    }

    pub(super) fn bus(&self, bus: &str) -> String {
        format!("{}/bus/{bus}", self.root)
    }

    /// A topic under a drive: `state`, `event`, `result`.
    pub(super) fn drive(&self, drive: &str, leaf: &str) -> String {
        format!("{}/drive/{drive}/{leaf}", self.root)
    }

    pub(super) fn point(&self, drive: &str, point: &str) -> String {
        format!("{}/drive/{drive}/point/{point}", self.root)
    }

    /// The filters of all set topics; with `clients`, also of those that name one of these clients, and of the
    /// holds. For a broker without wildcards, the topics of this plant.
    pub(super) fn set_filters(&self, plant: Option<&Plant>, clients: Option<&[String]>) -> Vec<String> {
        let any = || vec!["+".to_string()];
        let of_drive = |drive: DriveHandle| {
            let spec = &drive.image.spec;
            let points = spec.profile.points.iter().filter(|point| point.is_commanded());
            (spec.name.clone(), points.map(|point| point.name.clone()).collect())
        };
        let drives: Vec<(String, Vec<String>)> = match plant {
            None => vec![("+".to_string(), any())],
            Some(plant) => plant.drives().map(of_drive).collect(),
        };
        let sets = |who: &str| {
            let leaves = |(drive, points): &(String, Vec<String>)| {
                let points = points.iter().map(|point| format!("set/{point}"));
                let leaves = std::iter::once("set".to_string()).chain(points);
                leaves
                    .map(|leaf| self.drive(drive, &format!("{who}{leaf}")))
                    .collect::<Vec<_>>()
            };
            drives.iter().flat_map(leaves).collect::<Vec<_>>()
        };
        let mut filters = sets("");
        filters.push(format!("{}/set/stop", self.root));
        let Some(clients) = clients else { return filters };
        for who in plant.map_or_else(any, |_| clients.to_vec()) {
            filters.extend(sets(&format!("as/{who}/")));
            filters.extend(
                drives
                    .iter()
                    .map(|(drive, _)| self.drive(drive, &format!("as/{who}/hold"))),
            );
            filters.push(format!("{}/as/{who}/stop", self.root));
        }
        filters.extend(drives.iter().map(|(drive, _)| self.drive(drive, "hold")));
        filters
    }

    /// The command on a topic, and WHO of `as/WHO`; without `as` the command names no client. `None` for any other topic.
    pub(super) fn parse<'t>(&self, topic: &'t str) -> Option<(Target<'t>, Option<&'t str>)> {
        let rest = topic.strip_prefix(self.root.as_str())?.strip_prefix('/')?;
        let levels: Vec<&str> = rest.split('/').collect();
        let (drive, levels) = match levels.as_slice() {
            ["set", "stop"] => return Some((Target::StopAll, None)),
            ["as", who, "stop"] => return Some((Target::StopAll, Some(who))),
            ["drive", drive, levels @ ..] => (*drive, levels),
            _ => return None,
        };
        let (who, leaf) = match levels {
            ["as", who, leaf @ ..] => (Some(*who), leaf),
            leaf => (None, leaf),
        };
        let target = match leaf {
            ["set"] => Target::Set(drive, None),
            ["set", point] => Target::Set(drive, Some(point)),
            ["hold"] => Target::Hold(drive),
            _ => return None,
        };
        Some((target, who))
    }

    /// The topic for the answers to stop all.
    pub(super) fn result(&self) -> String {
        format!("{}/result", self.root)
    }
}

#[cfg(test)]
mod tests {
    use super::super::fixture;
    use super::*;

    #[test]
    fn topics_of_commands_are_recognised() {
        let topics = Topics::new("plant/a", "hall");
        let (set, hold, stop) = (Target::Set, Target::Hold, Target::StopAll);
        for (topic, target, who) in [
            ("drive/p1/set", set("p1", None), None),
            ("drive/p1/set/run", set("p1", Some("run")), None),
            ("drive/p1/as/x/set", set("p1", None), Some("x")),
            ("drive/p1/as/x/set/run", set("p1", Some("run")), Some("x")),
            ("drive/p1/hold", hold("p1"), None),
            ("drive/p1/as/x/hold", hold("p1"), Some("x")),
            ("set/stop", stop, None),
            ("as/x/stop", stop, Some("x")),
        ] {
            let topic = format!("plant/a/hall/{topic}");
            assert_eq!(topics.parse(&topic), Some((target, who)), "{topic}");
        }
        for other in [
            "plant/a/hall/drive/p1/set/run/x",
            "plant/a/hall/drive/p1/state",
            "plant/a/hall/drive/p1",
            "plant/a/hall/drive/p1/as/set",
            "plant/a/hall/drive/p1/as/x/y/hold",
            "plant/a/hallway/drive/p1/set",
            "plant/a/hall/as/x/y/stop",
            "plant/a/hall/as/stop",
            "plant/b/hall/set/stop",
            "drive/p1/set",
            "",
        ] {
            assert_eq!(topics.parse(other), None, "{other}");
        }
    }

    #[test]
    fn filters_match_what_is_recognised() {
        let topics = Topics::new("plant/a", "hall");
        let own = ["drive/+/set", "drive/+/set/+", "set/stop"];
        let named = [
            "drive/+/as/+/set",
            "drive/+/as/+/set/+",
            "drive/+/as/+/hold",
            "as/+/stop",
            "drive/+/hold",
        ];
        let below = |filters: &[&str]| filters.iter().map(|f| format!("plant/a/hall/{f}")).collect::<Vec<_>>();
        assert_eq!(topics.set_filters(None, None), below(&own));
        assert_eq!(
            topics.set_filters(None, Some(&["x".to_string()])),
            below(&[&own[..], &named].concat())
        );
        let plant = fixture::plant(&["p1", "p2"]);
        let filters = topics.set_filters(Some(&plant), Some(&["x".to_string()]));
        assert!(
            filters.iter().all(|filter| topics.parse(filter).is_some()),
            "{filters:?}"
        );
        for wanted in [
            "drive/p2/as/x/set/run",
            "drive/p1/hold",
            "as/x/stop",
            "drive/p1/set",
            "set/stop",
        ] {
            assert!(
                filters.contains(&format!("plant/a/hall/{wanted}")),
                "{wanted} in {filters:?}"
            );
        }
    }
}
