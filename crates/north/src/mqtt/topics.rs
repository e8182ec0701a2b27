//! Names of the topics, made and recognised.

use crate::plant::{DriveHandle, Plant};

/// The topics of one gateway.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Topics {
    /// `{base}/{gateway}`.
    root: String,
}

/// A set topic: the drive and, for a bare value, the point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct SetTopic<'t> {
    pub(super) drive: &'t str,
    pub(super) point: Option<&'t str>,
    /// WHO in `as/WHO`.
    pub(super) who: Option<&'t str>,
}

/// The topic at which the hold of a drive is taken, renewed, released or broken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct HoldTopic<'t> {
    pub(super) drive: &'t str,
    /// Without one it has no owner.
    pub(super) who: Option<&'t str>,
}

/// The topic at which all drives are stopped.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct StopTopic<'t> {
    /// WHO of `as/WHO`; without one it has no owner.
    pub(super) who: Option<&'t str>,
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

    /// The filters of all set topics.
    pub(super) fn set_filters(&self) -> [String; 3] {
        [self.drive("+", "set"), self.drive("+", "set/+"), self.stop_all()]
    }

    /// The filters of those of the topics that name a client, and of the holds.
    pub(super) fn authority_filters(&self) -> [String; 5] {
        [
            self.drive("+", "as/+/set"),
            self.drive("+", "as/+/set/+"),
            self.drive("+", "as/+/hold"),
            self.drive("+", "hold"),
            format!("{}/as/+/stop", self.root),
        ]
    }

    /// The same for these clients, for a broker that takes no wildcards.
    pub(super) fn authority_topics(&self, plant: &Plant, clients: &[String]) -> Vec<String> {
        let of_drive = |drive: DriveHandle| {
            let spec = &drive.image.spec;
            let points = || spec.profile.points.iter().filter(|point| point.is_commanded());
            let of_client = |who: &String| {
                let leaf = |leaf: &str| self.drive(&spec.name, &format!("as/{who}/{leaf}"));
                let points = points().map(|point| leaf(&format!("set/{}", point.name)));
                [leaf("set"), leaf("hold")]
                    .into_iter()
                    .chain(points)
                    .collect::<Vec<_>>()
            };
            let hold = self.drive(&spec.name, "hold");
            std::iter::once(hold)
                .chain(clients.iter().flat_map(of_client))
                .collect::<Vec<_>>()
        };
        let stops = clients.iter().map(|who| format!("{}/as/{who}/stop", self.root));
        stops.chain(plant.drives().flat_map(of_drive)).collect()
    }

    /// Who stops all drives by that topic; `None` for any other topic.
    pub(super) fn parse_stop_all<'t>(&self, topic: &'t str) -> Option<StopTopic<'t>> {
        let rest = topic.strip_prefix(self.root.as_str())?.strip_prefix('/')?;
        if rest == "set/stop" {
            return Some(StopTopic { who: None });
        }
        let who = rest.strip_prefix("as/")?.strip_suffix("/stop")?;
        (!who.contains('/')).then_some(StopTopic { who: Some(who) })
    }

    /// Whose hold of which drive a topic is about; `None` for any other topic.
    pub(super) fn parse_hold<'t>(&self, topic: &'t str) -> Option<HoldTopic<'t>> {
        let rest = topic.strip_prefix(self.root.as_str())?.strip_prefix("/drive/")?;
        let levels: Vec<&str> = rest.split('/').collect();
        match levels.as_slice() {
            [drive, "hold"] => Some(HoldTopic { drive, who: None }),
            [drive, "as", who, "hold"] => Some(HoldTopic { drive, who: Some(who) }),
            _ => None,
        }
    }

    /// Where all drives are stopped.
    pub(super) fn stop_all(&self) -> String {
        format!("{}/set/stop", self.root)
    }

    /// Where the answers to that go.
    pub(super) fn result(&self) -> String {
        format!("{}/result", self.root)
    }

    /// The set topics of each drive of this plant, for a broker that takes no wildcards.
    pub(super) fn set_topics(&self, plant: &Plant) -> Vec<String> {
        let of_drive = |drive: DriveHandle| {
            let spec = &drive.image.spec;
            let points = spec.profile.points.iter().filter(|point| point.is_commanded());
            let points = points.map(|point| self.drive(&spec.name, &format!("set/{}", point.name)));
            let whole = self.drive(&spec.name, "set");
            std::iter::once(whole).chain(points).collect::<Vec<String>>()
        };
        std::iter::once(self.stop_all())
            .chain(plant.drives().flat_map(of_drive))
            .collect()
    }

    /// Which drive and point a topic sets; `None` for any other topic.
    pub(super) fn parse_set<'t>(&self, topic: &'t str) -> Option<SetTopic<'t>> {
        let rest = topic.strip_prefix(self.root.as_str())?.strip_prefix("/drive/")?;
        let levels: Vec<&str> = rest.split('/').collect();
        let (drive, who, point) = match levels.as_slice() {
            [drive, "set"] => (drive, None, None),
            [drive, "set", point] => (drive, None, Some(*point)),
            [drive, "as", who, "set"] => (drive, Some(*who), None),
            [drive, "as", who, "set", point] => (drive, Some(*who), Some(*point)),
            _ => return None,
        };
        Some(SetTopic { drive, point, who })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_that_name_a_client_are_recognised() {
        let topics = Topics::new("plant/a", "hall");
        let set = |topic| topics.parse_set(topic).map(|t| (t.drive, t.who, t.point));
        assert_eq!(set("plant/a/hall/drive/p1/as/x/set"), Some(("p1", Some("x"), None)));
        assert_eq!(
            set("plant/a/hall/drive/p1/as/x/set/run"),
            Some(("p1", Some("x"), Some("run")))
        );
        assert_eq!(set("plant/a/hall/drive/p1/as/set"), None);
        let hold = |topic| topics.parse_hold(topic).map(|t| (t.drive, t.who));
        assert_eq!(hold("plant/a/hall/drive/p1/hold"), Some(("p1", None)));
        assert_eq!(hold("plant/a/hall/drive/p1/as/x/hold"), Some(("p1", Some("x"))));
        assert_eq!(hold("plant/a/hall/drive/p1/as/x/y/hold"), None);
        let stop = |topic| topics.parse_stop_all(topic).map(|t| t.who);
        assert_eq!(stop("plant/a/hall/set/stop"), Some(None));
        assert_eq!(stop("plant/a/hall/as/x/stop"), Some(Some("x")));
        for other in [
            "plant/a/hall/as/x/y/stop",
            "plant/a/hall/as/stop",
            "plant/b/hall/set/stop",
        ] {
            assert_eq!(topics.parse_stop_all(other), None, "{other}");
        }
    }

    #[test]
    fn set_topics_are_recognised() {
        let topics = Topics::new("plant/a", "hall");
        let parse = |topic| topics.parse_set(topic).map(|t| (t.drive, t.point));
        assert_eq!(parse("plant/a/hall/drive/p1/set"), Some(("p1", None)));
        assert_eq!(parse("plant/a/hall/drive/p1/set/run"), Some(("p1", Some("run"))));
        for other in [
            "plant/a/hall/drive/p1/set/run/x",
            "plant/a/hall/drive/p1/state",
            "plant/a/hall/drive/p1",
            "plant/a/hallway/drive/p1/set",
            "drive/p1/set",
            "",
        ] {
            assert_eq!(parse(other), None, "{other}");
        }
        assert_eq!(
            topics.set_filters(),
            [
                "plant/a/hall/drive/+/set",
                "plant/a/hall/drive/+/set/+",
                "plant/a/hall/set/stop"
            ]
        );
    }
}
