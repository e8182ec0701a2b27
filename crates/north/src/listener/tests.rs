use std::collections::VecDeque;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU16, Ordering};
use std::time::{Duration, Instant};

use tokio::io::AsyncReadExt;
use tokio::net::TcpListener;
use tokio::sync::mpsc;

use super::accept::Accept;
use super::*;

/// A listener that fails a number of times and then accepts.
struct Failing(Vec<io::Error>, TcpListener);

impl Accept for Failing {
    async fn accept(&mut self) -> io::Result<(TcpStream, SocketAddr)> {
        match self.0.pop() {
            Some(error) => Err(error),
            None => self.1.accept().await,
        }
    }

    fn has_client(&self) -> bool {
        false
    }
}

/// A handler that admits one connection and records all calls.
struct Recorder {
    events: mpsc::UnboundedSender<&'static str>,
    taken: Mutex<bool>,
}

impl ConnectionHandler for Recorder {
    type Permit = ();

    fn admit(&self, client: IpAddr) -> Option<()> {
        assert!(client.is_loopback());
        let taken = std::mem::replace(&mut *self.taken.lock().unwrap(), true);
        if taken {
            self.events.send("refused").unwrap();
        }
        (!taken).then_some(())
    }

    async fn serve(self: Arc<Self>, mut stream: Dated<TcpStream>, _: SocketAddr, (): ()) {
        self.events.send("served").unwrap();
        // The connection lasts until the client closes it.
        let _ = stream.read(&mut [0]).await;
        *self.taken.lock().unwrap() = false;
        self.events.send("ended").unwrap();
    }
}

struct OnePlaceServer {
    events: mpsc::UnboundedReceiver<&'static str>,
    handler: Arc<Recorder>,
    stats: Arc<NorthState>,
    stop: CancellationToken,
}

impl OnePlaceServer {
    fn new() -> OnePlaceServer {
        let (sender, events) = mpsc::unbounded_channel();
        let handler = Arc::new(Recorder {
            events: sender,
            taken: Mutex::default(),
        });
        OnePlaceServer {
            events,
            handler,
            stats: Arc::default(),
            stop: CancellationToken::new(),
        }
    }

    fn accept_loop(&self, address: SocketAddr) -> AcceptLoop<Recorder> {
        AcceptLoop {
            server: ServerKind::Http,
            address,
            handler: self.handler.clone(),
            state: self.stats.listeners.add(ServerKind::Http, address),
            tasks: TaskTracker::new(),
            stop: self.stop.clone(),
        }
    }

    fn listeners(&self) -> Listeners<Recorder> {
        Listeners::new(
            ServerKind::Http,
            self.stats.clone(),
            TaskTracker::new(),
            self.stop.clone(),
        )
    }

    async fn next(&mut self) -> &'static str {
        self.events.recv().await.unwrap()
    }
}

#[tokio::test(start_paused = true)]
async fn accept_errors_do_not_end_a_server() {
    let socket = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = socket.local_addr().unwrap();
    let mut rig = OnePlaceServer::new();
    let errors = [
        io::ErrorKind::Other,
        io::ErrorKind::ConnectionAborted,
        io::ErrorKind::OutOfMemory,
    ];
    let socket = Failing(errors.map(io::Error::from).into(), socket);
    let never = || -> io::Result<Failing> { panic!("the socket is not lost") };
    let server = tokio::spawn(rig.accept_loop(address).run(Some(socket), never));
    let first = TcpStream::connect(address).await.unwrap();
    assert_eq!(rig.next().await, "served");
    let _second = TcpStream::connect(address).await.unwrap();
    assert_eq!(rig.next().await, "refused");
    drop(first);
    assert_eq!(rig.next().await, "ended");
    let _third = TcpStream::connect(address).await.unwrap();
    assert_eq!(rig.next().await, "served", "the place is free again");
    rig.stop.cancel();
    server.await.unwrap();
}

#[tokio::test(start_paused = true)]
async fn a_lost_socket_is_bound_again_and_reported_meanwhile() {
    let mut rig = OnePlaceServer::new();
    let [first, second] = [(); 2].map(|()| bind("127.0.0.1:0".parse().unwrap()).unwrap());
    let address = second.local_addr().unwrap();
    let lost = io::Error::from_raw_os_error(rustix::io::Errno::INVAL.raw_os_error());
    let first = Failing(vec![lost], TcpListener::from_std(first).unwrap());
    let taken = || Err(io::Error::from(io::ErrorKind::AddrInUse));
    let second = Failing(Vec::new(), TcpListener::from_std(second).unwrap());
    let attempts = Mutex::new(VecDeque::from([taken(), taken(), Ok(second)]));
    let stats = rig.stats.clone();
    let seen = Arc::new(Mutex::new(Vec::new()));
    let rebind = {
        let (stats, seen) = (stats.clone(), seen.clone());
        move || {
            seen.lock().unwrap().extend(stats.listeners.reasons());
            attempts.lock().unwrap().pop_front().unwrap()
        }
    };
    let server = tokio::spawn(rig.accept_loop(address).run(Some(first), rebind));
    let _client = TcpStream::connect(address).await.unwrap();
    assert_eq!(rig.next().await, "served");
    assert_eq!(stats.listeners.reasons(), Vec::<String>::new());
    let seen = std::mem::take(&mut *seen.lock().unwrap());
    assert_eq!(seen.len(), 3, "{seen:?}");
    assert!(
        seen[0].starts_with(&format!("HTTP does not listen on {address}: Invalid argument")),
        "{seen:?}"
    );
    assert!(seen[2].contains("in use"), "{seen:?}");
    rig.stop.cancel();
    server.await.unwrap();
}

/// A starting server opens the listeners whose addresses exist, and the others when their addresses appear.
#[tokio::test]
async fn an_address_that_is_not_there_yet_is_tried_again_and_an_error_in_a_reload() {
    let mut rig = OnePlaceServer::new();
    let (mut listeners, handler) = (rig.listeners(), rig.handler.clone());
    let (here, nowhere) = (free_address(), SocketAddr::from(([203, 0, 113, 1], 7999)));
    let states = rig.stats.listeners.clone();
    reload(&mut listeners, &handler, &[nowhere, here]).await.unwrap();
    assert_eq!(listeners.addresses(false), [nowhere, here]);
    let reason = format!("HTTP does not listen on {nowhere}: Cannot assign requested address (os error 99); retrying");
    assert_eq!(states.reasons(), [reason]);
    assert_eq!(states.up(), [(ServerKind::Http, false)]);
    let _client = TcpStream::connect(here).await.unwrap();
    assert_eq!(rig.next().await, "served", "the other listener serves");
    let elsewhere = SocketAddr::from(([203, 0, 113, 2], 7999));
    let refused = reload(&mut listeners, &handler, &[nowhere, elsewhere]).await;
    assert!(refused.unwrap_err().to_string().contains("does not have that address"));
    assert_eq!(listeners.addresses(false), [nowhere, here], "nothing has changed");
    reload(&mut listeners, &handler, &[here]).await.unwrap();
    while !states.reasons().is_empty() {
        tokio::task::yield_now().await;
    }
    assert_eq!(states.up(), [(ServerKind::Http, true)]);
    rig.stop.cancel();
}

#[tokio::test(start_paused = true)]
async fn an_address_that_comes_is_listened_on() {
    let mut rig = OnePlaceServer::new();
    let socket = bind("127.0.0.1:0".parse().unwrap()).unwrap();
    let address = socket.local_addr().unwrap();
    let not_yet = || Err(io::Error::from(io::ErrorKind::AddrNotAvailable));
    let come = Failing(Vec::new(), TcpListener::from_std(socket).unwrap());
    let attempts = Mutex::new(VecDeque::from([not_yet(), not_yet(), Ok(come)]));
    let server = rig.accept_loop(address);
    let server = tokio::spawn(server.run(None, move || attempts.lock().unwrap().pop_front().unwrap()));
    let states = rig.stats.listeners.clone();
    while states.up() == [(ServerKind::Http, true)] {
        tokio::task::yield_now().await;
    }
    let _client = TcpStream::connect(address).await.unwrap();
    assert_eq!(rig.next().await, "served");
    assert_eq!(states.up(), [(ServerKind::Http, true)]);
    rig.stop.cancel();
    server.await.unwrap();
    assert_eq!(states.up(), [], "a server that ended has no listener");
}

/// Applies these listen addresses, as a reload does.
async fn reload(
    listeners: &mut Listeners<Recorder>,
    handler: &Arc<Recorder>,
    addresses: &[SocketAddr],
) -> Result<(), ServerError> {
    let new = listeners.prepare(specs(addresses)).await?;
    listeners.commit(new, |_, _, _| (handler.clone(), Handle::current()));
    Ok(())
}

fn specs(addresses: &[SocketAddr]) -> Vec<ListenerSpec> {
    let spec = |address: &SocketAddr| ListenerSpec {
        address: *address,
        tls: false,
        section: "[http]".to_string(),
    };
    addresses.iter().map(spec).collect()
}

/// An address outside the range that the system assigns, so that no other program gets it before it is bound again.
fn free_address() -> SocketAddr {
    static NEXT: AtomicU16 = AtomicU16::new(0);
    let first = 7_000 + (std::process::id() % 25) as u16 * 100;
    let addresses =
        std::iter::repeat_with(|| SocketAddr::from(([127, 0, 0, 1], first + NEXT.fetch_add(1, Ordering::Relaxed))));
    addresses
        .take(100)
        .find(|address| bind(*address).is_ok())
        .expect("a free port")
}

#[tokio::test]
async fn sockets_stay_while_they_are_wanted() {
    let mut rig = OnePlaceServer::new();
    let (mut listeners, handler) = (rig.listeners(), rig.handler.clone());
    let [stays, goes, comes] = [(); 3].map(|()| free_address());
    reload(&mut listeners, &handler, &[stays, goes]).await.unwrap();
    let client = TcpStream::connect(stays).await.unwrap();
    assert_eq!(rig.next().await, "served");
    reload(&mut listeners, &handler, &[comes, stays]).await.unwrap();
    assert_eq!(listeners.addresses(false), [comes, stays]);
    let _refused = TcpStream::connect(comes).await.unwrap();
    assert_eq!(rig.next().await, "refused", "the first client is still there");
    until_closed(goes).await;
    let taken = std::net::TcpListener::bind(goes).unwrap();
    let error = reload(&mut listeners, &handler, &[stays, goes]).await.unwrap_err();
    assert!(error.to_string().contains("Address already in use"), "{error}");
    assert_eq!(listeners.addresses(false), [comes, stays], "nothing has changed");
    drop((taken, client));
    assert_eq!(rig.next().await, "ended");
    rig.stop.cancel();
}

#[tokio::test]
async fn a_socket_that_overlaps_a_new_one_is_closed_for_it_or_comes_back() {
    let rig = OnePlaceServer::new();
    let (mut listeners, handler) = (rig.listeners(), rig.handler.clone());
    let narrow = free_address();
    let wide = SocketAddr::new([0, 0, 0, 0].into(), narrow.port());
    reload(&mut listeners, &handler, &[narrow]).await.unwrap();
    reload(&mut listeners, &handler, &[wide]).await.unwrap();
    assert_eq!(listeners.addresses(false), [wide]);
    reload(&mut listeners, &handler, &[narrow]).await.unwrap();
    assert_eq!(listeners.addresses(false), [narrow]);
    // The second address is taken, so the first stays as before.
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let refused = [wide, taken.local_addr().unwrap()];
    reload(&mut listeners, &handler, &refused).await.unwrap_err();
    assert_eq!(listeners.addresses(false), [narrow]);
    TcpStream::connect(narrow).await.unwrap();
    rig.stop.cancel();
}

/// A forked process has all sockets until it executes its program; this test imitates it with copies of the sockets.
#[tokio::test]
async fn an_address_is_free_as_soon_as_its_listener_is_closed() {
    let rig = OnePlaceServer::new();
    let (mut listeners, handler) = (rig.listeners(), rig.handler.clone());
    let [address, other] = [(); 2].map(|()| free_address());
    let mut copies = Vec::new();
    for tls in [false, true, false] {
        let spec = ListenerSpec {
            tls,
            ..specs(&[address]).remove(0)
        };
        let new = listeners.prepare(vec![spec]).await.unwrap();
        copies.extend(new.wanted[0].1.bound().map(|socket| socket.try_clone().unwrap()));
        listeners.commit(new, |_, _, _| (handler.clone(), Handle::current()));
        TcpStream::connect(address).await.unwrap();
    }
    assert_eq!(copies.len(), 3, "each has a socket of its own");
    let new = listeners.prepare(specs(&[address, other])).await.unwrap();
    copies.extend(new.wanted[1].1.bound().map(|socket| socket.try_clone().unwrap()));
    listeners.abort(new);
    bind(other).unwrap();
    rig.stop.cancel();
}

async fn until_closed(address: SocketAddr) {
    let deadline = Instant::now() + Duration::from_secs(60);
    while TcpStream::connect(address).await.is_ok() {
        assert!(Instant::now() < deadline, "{address} is still open");
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
}
