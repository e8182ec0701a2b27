//! Random connections, outages and changes.

use super::*;

/// Pseudo-random numbers, reproducible from the seed.
struct Dice(u64);

impl Dice {
    fn below(&mut self, limit: u64) -> u64 {
        self.0 = self
            .0
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) % limit
    }
}

/// A thousand connections with lost connections, births on request, drives that come and go, reloads, and a host
/// that goes offline. The watcher checks every message; at the end of each connection the host knows the present
/// state.
#[test]
fn a_thousand_connections() {
    for seed in 0..4 {
        let mut dice = Dice(seed);
        let mut bench = SessionWithHost::new(rules(if seed % 2 == 0 { "" } else { "scada" }), 5);
        let mut present = [true; 5];
        let (mut requested, mut number) = (0, 0.0);
        for connection in 0..250u32 {
            bench.connect((connection % 256) as u8);
            bench.session.subscribed();
            let births = bench.host.births;
            let mut alive = !bench.session.is_waiting();
            for _ in 0..dice.below(40) {
                bench.time += dice.below(120);
                let device = dice.below(5) as usize;
                number += 1.0;
                match dice.below(12) {
                    0 => present[device] = !present[device],
                    1 => {
                        bench.session.request_birth();
                        requested += 1;
                    }
                    2 if seed % 2 == 1 => {
                        let online = dice.below(3) > 0;
                        let ends = bench.state(online, bench.time);
                        alive |= online;
                        if ends {
                            let death = bench.session.end(bench.tick());
                            bench.host.see(&death);
                            break;
                        }
                    }
                    3 => {
                        let names: &[&str] = if dice.below(2) == 0 { &["a", "b"] } else { &["b", "a"] };
                        let devices = (0..5).map(|n| (format!("p{n}"), definitions(names)));
                        bench.session.adopt(definitions(&["Bus/line1/load"]), devices.collect());
                        bench.session.set_node(vec![sample(number, bench.time)]);
                        (0..5).for_each(|n| bench.tell(n, present[n], number));
                    }
                    _ => {}
                }
                bench.tell(device, present[device], number);
                bench.send(dice.below(6) as usize);
            }
            // Publishes everything that is due, also values postponed by the pace.
            for _ in 0..400 {
                bench.time += 50;
                bench.send(64);
            }
            if alive && bench.session.is_alive() {
                assert!(bench.host.births > births);
                let born: Vec<bool> = (0..5).map(|n| bench.host.born.contains(&format!("p{n}"))).collect();
                assert_eq!(born, present, "seed {seed}, connection {connection}");
                assert_eq!(
                    bench.waiting(),
                    bench
                        .session
                        .devices
                        .iter()
                        .filter(|d| !d.present)
                        .map(|d| d.history.len())
                        .sum::<usize>()
                );
            }
            bench.session.closed();
        }
        assert!(requested > 100 && !bench.host.deaths.is_empty() && !bench.host.past.is_empty());
    }
}
