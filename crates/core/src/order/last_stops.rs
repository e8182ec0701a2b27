//! The last stops of a machine, as far as they invalidate orders that were given earlier. Pure.

use std::time::Instant;

use super::Connection;

/// The last stop, and the last one of another connection: for an order of any connection, the last stop of the others is
/// one of these two.
#[derive(Debug, Clone, Default)]
pub struct LastStops {
    last: Option<(Connection, Instant)>,
    of_another: Option<(Connection, Instant)>,
}

impl LastStops {
    /// Notes an accepted stop.
    pub fn note(&mut self, connection: &Connection, at: Instant) {
        let at = self.time().map_or(at, |last| last.max(at));
        match &mut self.last {
            Some((last, since)) if last == connection => *since = at,
            last => self.of_another = last.replace((connection.clone(), at)),
        }
    }

    /// When the last stop was accepted.
    pub fn time(&self) -> Option<Instant> {
        self.last.as_ref().map(|(_, at)| *at)
    }

    /// When the last stop was accepted that came over a connection other than this one.
    pub fn of_others(&self, than: &Connection) -> Option<Instant> {
        let of = |stop: &&(Connection, Instant)| stop.0 != *than;
        let stop = self.last.as_ref().filter(of).or(self.of_another.as_ref().filter(of));
        stop.map(|(_, at)| *at)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    /// Keeping two stops is enough: compared with all stops, in every order of four stops from three connections.
    #[test]
    fn the_last_stop_of_the_others_is_known_for_each_connection() {
        let now = Instant::now();
        let all = [now, now, now].map(Connection::opened);
        for order in 0..81u32 {
            let (mut stops, mut each) = (LastStops::default(), Vec::new());
            for number in 0..4u32 {
                let at = now + Duration::from_secs(number.into());
                let of = &all[(order / 3u32.pow(number) % 3) as usize];
                stops.note(of, at);
                each.push((of.clone(), at));
                for one in &all {
                    let others = each.iter().filter(|(of, _)| of != one);
                    assert_eq!(
                        stops.of_others(one),
                        others.map(|(_, at)| *at).max(),
                        "{order}, {number}"
                    );
                }
            }
        }
    }
}
