//! Which requests a tool may send, by the present configuration of its slot: a reload also applies to a request
//! that waits for its share of the line, or that is only half received.

use std::net::IpAddr;
use std::path::PathBuf;
use std::sync::Arc;

use arc_swap::ArcSwap;

use super::{Options, Slot, SlotAccess};
use drivegate_core::order::{Grants, Proof, Right};

/// The kind of connection by which a tool is connected.
#[derive(Debug, Clone)]
enum ToolConnection {
    Address(IpAddr),
    Pty(PathBuf),
    /// Without a connection: a test that uses no sockets.
    Within,
}

/// The rights of one tool.
#[derive(Debug, Clone)]
pub(super) struct ToolRights {
    current: Arc<ArcSwap<Options>>,
    bus: Arc<str>,
    way: ToolConnection,
}

impl ToolRights {
    pub(super) fn new(current: &Arc<ArcSwap<Options>>, bus: &str, proof: &Proof) -> ToolRights {
        ToolRights {
            current: current.clone(),
            bus: bus.into(),
            way: match proof {
                Proof::Address(address) => ToolConnection::Address(*address),
                Proof::Pty(path) => ToolConnection::Pty(PathBuf::from(&**path)),
                _ => ToolConnection::Within,
            },
        }
    }

    /// The right to send what needs that access.
    pub(super) fn of(&self, needs: SlotAccess) -> Right {
        Right::of(Arc::new(ToolRight {
            rights: self.clone(),
            needs,
        }))
    }
}

#[derive(Debug)]
struct ToolRight {
    rights: ToolRights,
    needs: SlotAccess,
}

impl Grants for ToolRight {
    fn may_write(&self, bus: &str) -> bool {
        let ToolRights { current, bus: own, way } = &self.rights;
        let serves = |slot: &Slot| match way {
            ToolConnection::Address(address) => {
                slot.addresses().next().is_some() && slot.allow.iter().any(|network| network.contains(address))
            }
            ToolConnection::Pty(path) => slot.pty.as_ref() == Some(path),
            ToolConnection::Within => true,
        };
        let current = current.load();
        let mut slots = current.slots.iter();
        bus == &**own && slots.any(|slot| slot.bus == bus && slot.access >= self.needs && serves(slot))
    }
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, Instant};

    use drivegate_testkit::{STALE_AFTER, bus, bus_spec, controlled, image, nx, nx_plant, online, read_nx, up};

    use super::super::Loopback;
    use super::*;
    use drivegate_core::plant::{Plant, SharedPlant};
    use drivegate_proto::{LineFormat, Protocol, RequestPdu, rtu};

    fn slot(access: SlotAccess) -> Slot {
        Slot {
            bus: "line1".to_string(),
            protocol: Protocol::ModbusRtu,
            format: LineFormat::new(9600, "8N1").unwrap(),
            listen: Some("127.0.0.1:0".parse().unwrap()),
            rfc2217: None,
            pty: Some("/tmp/tool".into()),
            access,
            allow: vec!["127.0.0.0/8".parse().unwrap()],
            idle_timeout: None,
        }
    }

    #[test]
    fn a_right_is_that_of_the_slot_as_it_is_now() {
        use SlotAccess::{Raw, Read, Write};
        let current = Arc::new(ArcSwap::from_pointee(Options::default()));
        let ways = [Proof::Address([127, 0, 0, 1].into()), Proof::Pty("/tmp/tool".into())];
        let others = [Proof::Address([10, 0, 0, 1].into()), Proof::Pty("/tmp/other".into())];
        for proof in ways.iter().chain(&others) {
            let rights = ToolRights::new(&current, "line1", proof);
            for access in [Read, Write, Raw] {
                current.store(Arc::new(Options {
                    slots: vec![slot(access)],
                }));
                for needs in [Write, Raw] {
                    let right = rights.of(needs);
                    let expected = ways.contains(proof) && access >= needs;
                    assert_eq!(right.allows("line1"), expected, "{proof:?} {access:?} {needs:?}");
                    assert!(!right.allows("line2"));
                }
            }
            current.store(Arc::default());
            assert!(!rights.of(Write).allows("line1"), "the slot is gone");
        }
    }

    struct Tool {
        tool: Loopback,
        plant: SharedPlant,
        now: Instant,
    }

    impl Tool {
        fn new(access: SlotAccess) -> Tool {
            Tool::of(nx_plant(&["p1"]), access)
        }

        fn of(plant: Plant, access: SlotAccess) -> Tool {
            let now = Instant::now();
            let image = plant.drive("p1").unwrap().image;
            online(&image);
            read_nx(&plant, "p1", 1, 0, now);
            let plant: SharedPlant = Arc::new(ArcSwap::from_pointee(plant));
            Tool {
                tool: Loopback::new(slot(access), plant.clone(), Arc::default(), "127.0.0.1:1"),
                plant,
                now,
            }
        }

        fn waiting(&self) -> usize {
            let plant = self.plant.load();
            let queue = &plant.buses[0].queue;
            let background = queue.background().iter().count();
            queue.lock().writes() + background
        }
    }

    fn frame(address: u8, pdu: &RequestPdu) -> Vec<u8> {
        let (mut bytes, mut frame) = (Vec::new(), Vec::new());
        pdu.encode(&mut bytes);
        rtu::encode_frame(address, &bytes, &mut frame);
        frame
    }

    #[test]
    fn a_drive_at_the_reserved_address_is_reached() {
        let (write, drive) = (
            RequestPdu::write_register(2002, 1000),
            controlled("p1", "line1", 248, &nx()),
        );
        let bus = up(bus(bus_spec("line1"), vec![image(drive)]));
        let mut rig = Tool::of(Plant::new("hall", STALE_AFTER, vec![bus]), SlotAccess::Write);
        assert!(rig.tool.receive(&frame(248, &write), rig.now).is_empty());
        assert_eq!(rig.waiting(), 1);
        // On a line without it, nobody answers.
        let mut rig = Tool::new(SlotAccess::Raw);
        assert!(rig.tool.receive(&frame(248, &write), rig.now).is_empty());
        assert_eq!((rig.waiting(), rig.tool.is_waiting()), (0, false));
    }

    /// When the right is removed: after the first half of the frame, or while the write waits for its share of the line.
    #[derive(Debug, Clone, Copy, PartialEq)]
    enum Goes {
        Half,
        Held,
    }

    #[test]
    fn a_request_that_had_begun_has_the_right_of_its_end() {
        use SlotAccess::{Raw, Read, Write};
        let start = RequestPdu::write_register(2000, 1);
        let reference = RequestPdu::write_register(2002, 1000);
        let undecoded = RequestPdu::Other(vec![0x43, 1]);
        // Columns: address, request, access before and after, and whether the request goes to the bus.
        let table = [
            (1, &start, Write, Write, true),
            (1, &start, Write, Read, false),
            (1, &start, Raw, Write, true),
            (1, &start, Raw, Read, false),
            (0, &start, Raw, Raw, true),
            (0, &start, Raw, Write, false),
            (77, &start, Raw, Raw, true),
            (77, &start, Raw, Write, false),
            (1, &undecoded, Raw, Raw, true),
            (1, &undecoded, Raw, Write, false),
        ];
        for goes in [Goes::Half, Goes::Held] {
            for (address, pdu, before, after, passes) in table {
                let mut rig = Tool::new(before);
                let what = format!("{goes:?} {address} {pdu:?} {before:?} {after:?}");
                let bytes = frame(address, pdu);
                let (first, rest) = bytes.split_at(bytes.len() / 2);
                let count = match goes {
                    Goes::Half => {
                        assert!(rig.tool.receive(first, rig.now).is_empty());
                        rig.tool.reload(after);
                        0
                    }
                    Goes::Held => {
                        // The reference uses up the share of the tools.
                        rig.tool.receive(&frame(1, &reference), rig.now);
                        rig.now += Duration::from_millis(50);
                        rig.tool.receive(first, rig.now);
                        let count = rig.waiting();
                        rig.tool.receive(rest, rig.now);
                        rig.tool.reload(after);
                        count
                    }
                };
                let (rest, mut reply) = match goes {
                    Goes::Half => (rest, Vec::new()),
                    Goes::Held => (&[][..], Vec::new()),
                };
                for bytes in [rest, &[], &[]] {
                    reply.extend(rig.tool.receive(bytes, rig.now));
                    rig.now = rig.tool.wake_at().unwrap_or(rig.now).max(rig.now);
                    if rig.waiting() > count {
                        break;
                    }
                }
                assert_eq!(rig.waiting() > count, passes, "{what}");
                if !passes && address != 0 {
                    assert_eq!(reply[1..3], [bytes[1] | 0x80, 1], "{what}: {reply:?}");
                }
            }
        }
    }
}
