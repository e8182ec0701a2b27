//! Names of the topics: `spBv1.0/{group}/{message type}/{node}[/{device}]`.

/// First level of all topics.
const NAMESPACE: &str = "spBv1.0";

/// Types of the messages that the gateway sends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    NodeBirth,
    NodeData,
    NodeDeath,
    DeviceBirth,
    DeviceData,
    DeviceDeath,
}

impl Kind {
    fn name(self) -> &'static str {
        match self {
            Kind::NodeBirth => "NBIRTH",
            Kind::NodeData => "NDATA",
            Kind::NodeDeath => "NDEATH",
            Kind::DeviceBirth => "DBIRTH",
            Kind::DeviceData => "DDATA",
            Kind::DeviceDeath => "DDEATH",
        }
    }
}

/// The subject of a message from the broker.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Received<'t> {
    /// The primary host is online or offline.
    State(StateForm),
    NodeCommand,
    DeviceCommand(&'t str),
}

/// The version of Sparkplug that the primary host's state messages follow.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum StateForm {
    /// 3.0: `spBv1.0/STATE/{host}`, an object with the time.
    Object,
    /// 2.2: `STATE/{host}`, a word.
    Word,
}

/// The topics of one edge node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Topics {
    group: String,
    node: String,
    /// Name of the primary host; empty if there is none.
    primary_host: String,
}

impl Topics {
    pub(super) fn new(group: &str, node: &str, primary_host: &str) -> Topics {
        Topics {
            group: group.to_string(),
            node: node.to_string(),
            primary_host: primary_host.to_string(),
        }
    }

    /// The topic of a message type; `device` only for devices.
    pub(super) fn of(&self, kind: Kind, device: Option<&str>) -> String {
        let (group, kind, node) = (&self.group, kind.name(), &self.node);
        match device {
            Some(device) => format!("{NAMESPACE}/{group}/{kind}/{node}/{device}"),
            None => format!("{NAMESPACE}/{group}/{kind}/{node}"),
        }
    }

    /// The descriptor of the node, for messages.
    pub(super) fn node(&self) -> String {
        format!("{}/{}", self.group, self.node)
    }

    pub(super) fn node_commands(&self) -> String {
        format!("{NAMESPACE}/{}/NCMD/{}", self.group, self.node)
    }

    /// Filter of the commands of all devices.
    pub(super) fn device_commands(&self) -> String {
        format!("{NAMESPACE}/{}/DCMD/{}/+", self.group, self.node)
    }

    /// The commands of one device, for a broker that takes no wildcards.
    pub(super) fn commands_of(&self, device: &str) -> String {
        format!("{NAMESPACE}/{}/DCMD/{}/{device}", self.group, self.node)
    }

    /// Topic of the primary host's state; `None` without a primary host.
    pub(super) fn state(&self) -> Option<String> {
        (!self.primary_host.is_empty()).then(|| format!("{NAMESPACE}/STATE/{}", self.primary_host))
    }

    /// The state topic in the form of Sparkplug 2.2.
    pub(super) fn old_state(&self) -> Option<String> {
        (!self.primary_host.is_empty()).then(|| format!("STATE/{}", self.primary_host))
    }

    /// Parses a topic; `None` for topics to which the client did not subscribe.
    pub(super) fn parse<'t>(&self, topic: &'t str) -> Option<Received<'t>> {
        if self.state().is_some_and(|state| state == topic) {
            return Some(Received::State(StateForm::Object));
        }
        if self.old_state().is_some_and(|state| state == topic) {
            return Some(Received::State(StateForm::Word));
        }
        if topic == self.node_commands() {
            return Some(Received::NodeCommand);
        }
        let filter = self.device_commands();
        let device = topic.strip_prefix(filter.trim_end_matches('+'))?;
        (!device.contains('/')).then_some(Received::DeviceCommand(device))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_are_made_and_recognised() {
        let topics = Topics::new("plant", "hall", "scada");
        assert_eq!(topics.of(Kind::NodeBirth, None), "spBv1.0/plant/NBIRTH/hall");
        assert_eq!(topics.of(Kind::DeviceDeath, Some("p1")), "spBv1.0/plant/DDEATH/hall/p1");
        for (topic, expected) in [
            ("spBv1.0/STATE/scada", Some(Received::State(StateForm::Object))),
            ("STATE/scada", Some(Received::State(StateForm::Word))),
            ("STATE/other", None),
            ("spBv1.0/plant/NCMD/hall", Some(Received::NodeCommand)),
            ("spBv1.0/plant/DCMD/hall/p1", Some(Received::DeviceCommand("p1"))),
            ("spBv1.0/plant/DCMD/hall/p1/x", None),
            ("spBv1.0/plant/DCMD/hall", None),
            ("spBv1.0/STATE/other", None),
        ] {
            assert_eq!(topics.parse(topic), expected, "{topic}");
        }
        assert_eq!(Topics::new("plant", "hall", "").state(), None);
    }
}
