use proptest::prelude::*;

use super::*;

fn host(n: u8) -> IpAddr {
    IpAddr::from([10, 0, 0, n])
}

/// Connection places; a test opens and closes the connections.
struct LimitedPlaces {
    limit: Arc<ConnectionLimit>,
    cancel: CancellationToken,
    now: Instant,
}

impl LimitedPlaces {
    fn new(limits: Limits) -> LimitedPlaces {
        LimitedPlaces {
            limit: ConnectionLimit::new(limits),
            cancel: CancellationToken::new(),
            now: Instant::now(),
        }
    }

    /// Opens a connection a millisecond later.
    fn connect(
        &mut self,
        address: IpAddr,
        authority: Authority,
    ) -> Result<(ConnectionPermit, Option<IpAddr>), NoPlace> {
        self.now += std::time::Duration::from_millis(1);
        let newcomer = Newcomer {
            address,
            listener: 0,
            cancel: &self.cancel,
        };
        self.limit.acquire(newcomer, self.now, || Some(authority))
    }

    fn reader(&mut self, n: u8) -> Result<(ConnectionPermit, Option<IpAddr>), NoPlace> {
        self.connect(host(n), Authority::ReadOnly)
    }

    fn operator(&mut self, n: u8) -> Result<(ConnectionPermit, Option<IpAddr>), NoPlace> {
        self.connect(host(n), Authority::Write)
    }

    fn in_use(&mut self, permit: &ConnectionPermit) {
        self.now += std::time::Duration::from_millis(1);
        permit.place().use_at(self.now, true);
    }
}

fn is_displaced(permit: &ConnectionPermit) -> bool {
    assert_eq!(
        permit.place().close_reason().is_some(),
        permit.place().closing().is_cancelled()
    );
    permit.place().close_reason() == Some(CloseReason::Displaced)
}

#[test]
fn an_address_keeps_what_it_uses_and_yields_what_it_does_not() {
    let mut rig = LimitedPlaces::new(Limits::new(8, 2));
    let (first, _) = rig.reader(1).unwrap();
    let (second, _) = rig.reader(1).unwrap();
    rig.in_use(&first);
    let (third, displaced) = rig.reader(1).unwrap();
    assert_eq!(displaced, Some(host(1)));
    assert!(is_displaced(&second) && !is_displaced(&first), "the silent one yields");
    rig.in_use(&third);
    let full = NoPlace::Limit(LimitReached::Address(2));
    assert_eq!(rig.reader(1).unwrap_err(), full);
    let (_operator, displaced) = rig.operator(1).unwrap();
    assert_eq!(
        displaced,
        Some(host(1)),
        "who may write goes before who reads at the same address"
    );
    assert!(is_displaced(&first));
}

#[test]
fn of_those_that_came_in_one_millisecond_the_first_yields() {
    let rig = LimitedPlaces::new(Limits::new(8, 8));
    let newcomer = Newcomer {
        address: host(1),
        listener: 0,
        cancel: &rig.cancel,
    };
    let connect = |_| {
        rig.limit
            .acquire(newcomer, rig.now, || Some(Authority::Write))
            .unwrap()
            .0
    };
    let permits: Vec<ConnectionPermit> = (0..12).map(connect).collect();
    let displaced: Vec<usize> = (0..12).filter(|n| is_displaced(&permits[*n])).collect();
    assert_eq!(displaced, [0, 1, 2, 3]);
}

#[test]
fn the_longest_idle_connection_of_the_largest_holder_yields() {
    let mut rig = LimitedPlaces::new(Limits::new(4, 3));
    let permits: Vec<_> = [1, 1, 1, 2].map(|n| rig.reader(n).unwrap().0).into();
    for permit in [&permits[0], &permits[2], &permits[1], &permits[3]] {
        rig.in_use(permit);
    }
    rig.in_use(&permits[0]);
    let (newcomer, displaced) = rig.reader(3).unwrap();
    assert_eq!(displaced, Some(host(1)));
    assert!(is_displaced(&permits[2]), "its third was used before the others");
    rig.in_use(&newcomer);
    assert_eq!(
        rig.reader(1).unwrap_err(),
        NoPlace::Limit(LimitReached::Total(4)),
        "nobody has more than it"
    );
    drop(newcomer);
    assert_eq!(rig.reader(3).unwrap().1, None, "the place is free again");
}

#[test]
fn operators_have_places_and_keep_them() {
    let mut rig = LimitedPlaces::new(Limits::new(16, 16).with_reserve());
    let mut readers = Vec::new();
    for n in 0..100 {
        readers.extend(rig.reader(n).ok());
    }
    let (operator, displaced) = rig.operator(200).unwrap();
    assert_eq!(displaced, None, "two of sixteen places are reserved");
    let (other, displaced) = rig.operator(201).unwrap();
    assert_eq!(displaced, None);
    for n in 0..=255 {
        readers.extend(rig.reader(n).ok());
    }
    assert!(!is_displaced(&operator) && !is_displaced(&other));
    // Displaced connections are closed before more are displaced.
    readers.retain(|(permit, _)| !is_displaced(permit));
    let (_third, displaced) = rig.operator(202).unwrap();
    assert!(displaced.is_some(), "a reader yields to an operator beyond the reserve");
}

#[test]
fn closing_connections_are_bounded() {
    for total in [1, MAX_CLOSING + 8] {
        let limits = Limits::new(total, 1);
        let mut rig = LimitedPlaces::new(limits);
        let mut permits = Vec::new();
        for n in 0..limits.files() as u8 {
            permits.push(rig.reader(n).unwrap());
        }
        let full = NoPlace::Limit(LimitReached::Total(total));
        assert_eq!(rig.reader(200).unwrap_err(), full);
        permits.remove(0);
        assert!(rig.reader(200).is_ok(), "one of them has closed");
    }
}

#[test]
fn a_review_changes_rights_and_closes() {
    let mut rig = LimitedPlaces::new(Limits::new(4, 4));
    let (stays, _) = rig.operator(1).unwrap();
    let (goes, _) = rig.operator(2).unwrap();
    let rights = stays.place().rights().clone();
    rig.limit.review(1, |_| None);
    assert_eq!(rights.authority(), Authority::Write, "of another listener");
    rig.limit
        .review(0, |place| (place.address() == host(1)).then_some(Authority::ReadOnly));
    assert_eq!(rights.authority(), Authority::ReadOnly);
    assert!(!stays.place().closing().is_cancelled());
    assert_eq!(goes.place().close_reason(), Some(CloseReason::NotAllowed));
    let newcomer = Newcomer {
        address: host(3),
        listener: 0,
        cancel: &rig.cancel,
    };
    let refused = rig.limit.acquire(newcomer, rig.now, || None).unwrap_err();
    assert_eq!(refused, NoPlace::NotAllowed);
}

fn limits() -> impl Strategy<Value = Limits> {
    (1..24_usize, 1..8_usize, any::<bool>()).prop_map(|(total, per_address, reserve)| {
        let limits = Limits::new(total, per_address);
        if reserve { limits.with_reserve() } else { limits }
    })
}

fn newcomer() -> impl Strategy<Value = (u8, bool, u8)> {
    // A few addresses connect often and many connect seldom. After that, each connection stays silent, is used, or
    // is closed.
    (prop_oneof![0..4_u8, 0..64_u8], prop::bool::weighted(0.3), 0..4_u8)
}

proptest! {
    /// Property for any sequence of connections: no limit is exceeded, and connections that must stay are not displaced.
    #[test]
    fn limits_hold_and_operators_stay(limits in limits(), newcomers in prop::collection::vec(newcomer(), 1..200)) {
        let mut rig = LimitedPlaces::new(limits);
        let mut permits: Vec<(ConnectionPermit, Authority)> = Vec::new();
        for (n, writes, then) in newcomers {
            let authority = if writes { Authority::Write } else { Authority::ReadOnly };
            let count = |select: &dyn Fn(&ConnectionPlace, Authority) -> bool| {
                permits.iter().filter(|(permit, authority)| select(permit.place(), *authority)).count()
            };
            let own = count(&|place, _| place.address() == host(n));
            let operators = count(&|_, authority| authority == Authority::Write);
            let readers = permits.len() - operators;
            let held: HashMap<IpAddr, usize> = permits.iter().fold(HashMap::new(), |mut held, (permit, _)| {
                *held.entry(permit.place().address()).or_default() += 1;
                held
            });
            match rig.connect(host(n), authority) {
                Ok((permit, displaced)) => {
                    let gone = permits.iter().position(|(permit, _)| is_displaced(permit));
                    prop_assert_eq!(displaced.is_some(), gone.is_some());
                    if let Some((gone, its)) = gone.map(|index| permits.swap_remove(index)) {
                        let place = gone.place();
                        prop_assert!(writes || its == Authority::ReadOnly, "an operator yielded to a reader");
                        let own_address = place.address() == host(n);
                        prop_assert!(!own_address || !place.is_in_use() || its != authority);
                        prop_assert!(own_address || held[&place.address()] > own, "from who has no more");
                        prop_assert!(!writes || operators >= limits.reserved || own >= limits.per_address);
                    }
                    if then == 1 {
                        rig.in_use(&permit);
                    }
                    permits.push((permit, authority));
                }
                Err(_) => {
                    prop_assert!(own > 0 || (!writes && readers == 0), "a client without a connection is refused");
                    prop_assert!(own >= limits.per_address || !writes || operators >= limits.reserved);
                }
            }
            if then == 2 && !permits.is_empty() {
                permits.swap_remove(usize::from(n) % permits.len());
            }
            let of = |address: IpAddr| permits.iter().filter(|(p, _)| p.place().address() == address).count();
            let readers = permits.iter().filter(|(_, a)| *a == Authority::ReadOnly).count();
            prop_assert!(permits.len() <= limits.total && of(host(n)) <= limits.per_address);
            prop_assert!(readers <= limits.total - limits.reserved);
        }
    }

    /// An operator always gets a connection, regardless of how many silent connections other addresses open.
    #[test]
    fn silence_locks_no_operator_out(
        limits in limits().prop_filter("one place for an operator", |l| l.reserved > 0),
        silent in prop::collection::vec(1..=255_u8, 0..300),
    ) {
        let mut rig = LimitedPlaces::new(limits);
        let mut permits = Vec::new();
        for n in silent {
            permits.extend(rig.reader(n).ok());
            permits.retain(|(permit, _)| !is_displaced(permit));
            let (_operator, displaced) = rig.operator(0).unwrap();
            prop_assert_eq!(displaced, None);
        }
    }
}

#[test]
fn who_is_closed_for_its_right_has_none_and_who_yields_keeps_it() {
    let mut places = LimitedPlaces::new(Limits::new(8, 8));
    let permits: Vec<ConnectionPermit> = (1..=4).map(|n| places.operator(n).unwrap().0).collect();
    let rights: Vec<Rights> = permits.iter().map(|permit| permit.place().rights().clone()).collect();
    let may_write = || {
        rights
            .iter()
            .map(|rights| rights.authority() == Authority::Write)
            .collect::<Vec<_>>()
    };
    assert_eq!(may_write(), [true; 4]);
    permits[0].place().close(CloseReason::CertificateRefused);
    permits[1].place().close(CloseReason::Displaced);
    let judge = |place: &ConnectionPlace| match place.address() {
        address if address == host(3) => None,
        address if address == host(4) => Some(Authority::ReadOnly),
        _ => Some(place.rights().authority()),
    };
    places.limit.review(0, judge);
    assert_eq!(may_write(), [false, true, false, false]);
}
