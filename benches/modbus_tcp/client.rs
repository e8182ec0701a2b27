//! A client that sends the next request as soon as one is answered: one thread, any number of connections, batches
//! of any depth.

use std::error::Error;
use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use rustix::event::epoll;

use crate::common::quantile;

/// Function 3, eleven registers from 2100 of unit 1.
const REQUEST: [u8; 12] = [0, 1, 0, 0, 0, 6, 1, 3, 0x08, 0x34, 0, 11];
const ANSWER: usize = 31;

/// Result of a measurement with a client.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Load {
    /// Requests answered in a second.
    pub(crate) rate: f64,
    /// Time from sending a batch to its last answer, µs.
    pub(crate) p50: f64,
    pub(crate) p99: f64,
    /// Number of requests answered.
    pub(crate) answered: u64,
}

struct Connection {
    stream: TcpStream,
    sent: Instant,
    /// Number of bytes of the batch that have not arrived yet.
    missing: usize,
}

/// Keeps a batch of `depth` requests in progress on each connection for `time`.
pub(crate) fn load(
    address: SocketAddr,
    connections: usize,
    depth: usize,
    time: Duration,
) -> Result<Load, Box<dyn Error>> {
    let batch = REQUEST.repeat(depth);
    let mut all = Vec::with_capacity(connections);
    let epoll = epoll::create(epoll::CreateFlags::CLOEXEC)?;
    for place in 0..connections {
        let stream = TcpStream::connect(address)?;
        stream.set_nodelay(true)?;
        stream.set_nonblocking(connections > 1)?;
        stream.set_read_timeout(Some(Duration::from_secs(5)))?;
        epoll::add(
            &epoll,
            &stream,
            epoll::EventData::new_u64(place as u64),
            epoll::EventFlags::IN,
        )?;
        all.push(Connection {
            stream,
            sent: Instant::now(),
            missing: 0,
        });
    }
    let mut latencies: Vec<f64> = Vec::with_capacity(1 << 20);
    let (mut answered, begin) = (0, Instant::now());
    for connection in &mut all {
        begin_batch(connection, &batch)?;
    }
    let mut buffer = vec![0; 64 * 1024];
    let mut events: Vec<epoll::Event> = Vec::with_capacity(connections);
    let mut ready = vec![0];
    while begin.elapsed() < time {
        if connections > 1 {
            events.clear();
            let patience = rustix::event::Timespec { tv_sec: 5, tv_nsec: 0 };
            epoll::wait(&epoll, rustix::buffer::spare_capacity(&mut events), Some(&patience))?;
            if events.is_empty() {
                return Err("no answer for five seconds".into());
            }
            ready.clear();
            ready.extend(events.iter().map(|event| event.data.u64() as usize));
        }
        for &place in &ready {
            let Some(connection) = all.get_mut(place) else { continue };
            let count = match connection.stream.read(&mut buffer) {
                Ok(0) => return Err("the server has closed the connection".into()),
                Ok(count) => count,
                Err(why) if why.kind() == ErrorKind::WouldBlock => continue,
                Err(why) => return Err(why.into()),
            };
            // The first answer of the batch must begin with function 3, not with its exception.
            if connection.missing == depth * ANSWER && buffer.get(7) != Some(&3) {
                return Err(format!("an exception: {:?}", buffer.get(..count.min(20))).into());
            }
            connection.missing = connection
                .missing
                .checked_sub(count)
                .ok_or("more bytes than asked for")?;
            if connection.missing == 0 {
                latencies.push(connection.sent.elapsed().as_secs_f64() * 1e6);
                answered += depth as u64;
                begin_batch(connection, &batch)?;
            }
        }
    }
    Ok(Load {
        rate: answered as f64 / begin.elapsed().as_secs_f64(),
        p50: quantile(&latencies, 0.5),
        p99: quantile(&latencies, 0.99),
        answered,
    })
}

fn begin_batch(connection: &mut Connection, batch: &[u8]) -> std::io::Result<()> {
    connection.sent = Instant::now();
    connection.missing = batch.len() / REQUEST.len() * ANSWER;
    // A batch is small: it fits the buffer of the socket as a whole.
    connection.stream.write_all(batch)
}
