//! Where packets begin and end among the bytes from the broker, so that a packet in several parts dates from its first
//! byte. Pure.
//!
//! The content of TLS is hidden at this place: there the records count. Brokers put a packet into one record unless it is
//! larger than a record.

use drivegate_north::reading::{FrameEnd, Frames};

/// The end of an HTTP head.
const HEAD_END: &[u8] = b"\r\n\r\n";

/// The frames of a connection.
#[derive(Debug)]
pub(super) struct PacketFrames {
    /// Number of HTTP heads that precede the frames: the replies of a proxy, and to the request for WebSocket.
    heads: usize,
    /// How many bytes of [`HEAD_END`] were received.
    matched: usize,
    web_socket: Option<Layer>,
    /// Packets, or records of TLS.
    inner: Layer,
    /// Whether the last bytes did not end a frame.
    is_open: bool,
}

/// What carries the packets of a connection.
#[derive(Debug, Clone, Copy)]
pub(super) struct Carrier {
    pub(super) proxy: bool,
    pub(super) tls: bool,
    pub(super) web_socket: bool,
}

/// Frames of one protocol.
#[derive(Debug)]
struct Layer {
    head: Vec<u8>,
    /// Bytes that the body still lacks; `None` until the head is complete.
    left: Option<u64>,
    /// Length of the body, if the head is complete.
    length: fn(&[u8]) -> Option<u64>,
}

impl PacketFrames {
    pub(super) fn new(carrier: Carrier) -> PacketFrames {
        let web_socket = carrier.web_socket && !carrier.tls;
        PacketFrames {
            heads: usize::from(carrier.proxy) + usize::from(web_socket),
            matched: 0,
            web_socket: web_socket.then(|| Layer::new(web_socket_length)),
            inner: Layer::new(if carrier.tls { record_length } else { packet_length }),
            is_open: false,
        }
    }

    fn skip_head(&mut self, bytes: &mut &[u8]) {
        while let Some((byte, rest)) = bytes.split_first() {
            *bytes = rest;
            self.matched = if HEAD_END.get(self.matched) == Some(byte) {
                self.matched + 1
            } else {
                usize::from(HEAD_END.first() == Some(byte))
            };
            if self.matched == HEAD_END.len() {
                (self.heads, self.matched) = (self.heads - 1, 0);
                return;
            }
        }
    }

    /// Takes the bytes of one frame from the front, as far as they are there; returns whether nothing is incomplete then.
    fn take(&mut self, bytes: &mut &[u8]) -> bool {
        let Some(outer) = &mut self.web_socket else {
            self.inner.take(bytes);
            return self.inner.is_whole();
        };
        let mut body = outer.take(bytes);
        // Pings and the like may come between the parts of a packet.
        while outer.is_data() && !body.is_empty() {
            self.inner.take(&mut body);
        }
        outer.is_whole() && self.inner.is_whole()
    }
}

impl Frames for PacketFrames {
    fn pass(&mut self, mut bytes: &[u8]) -> FrameEnd {
        let mut end = if self.is_open {
            FrameEnd::Continued
        } else {
            FrameEnd::Whole
        };
        while self.heads > 0 && !bytes.is_empty() {
            self.skip_head(&mut bytes);
        }
        while !bytes.is_empty() {
            if self.take(&mut bytes) {
                end = FrameEnd::Whole;
            } else if end == FrameEnd::Whole {
                end = FrameEnd::Begun;
            }
        }
        self.is_open = end != FrameEnd::Whole;
        end
    }
}

impl Layer {
    fn new(length: fn(&[u8]) -> Option<u64>) -> Layer {
        Layer {
            head: Vec::new(),
            left: None,
            length,
        }
    }

    fn is_whole(&self) -> bool {
        self.left.map_or(self.head.is_empty(), |left| left == 0)
    }

    /// Whether a frame of WebSocket carries data.
    fn is_data(&self) -> bool {
        self.head.first().is_some_and(|first| first & 0x0F < 8)
    }

    /// Takes the bytes up to the end of a frame from the front; returns those of its body.
    fn take<'b>(&mut self, bytes: &mut &'b [u8]) -> &'b [u8] {
        if self.left == Some(0) {
            self.head.clear();
            self.left = None;
        }
        while self.left.is_none()
            && let Some((byte, rest)) = bytes.split_first()
        {
            *bytes = rest;
            self.head.push(*byte);
            self.left = (self.length)(&self.head);
        }
        let Some(left) = &mut self.left else { return &[] };
        let count = usize::try_from(*left).unwrap_or(usize::MAX).min(bytes.len());
        let (body, rest) = bytes.split_at(count);
        (*left, *bytes) = (*left - count as u64, rest);
        body
    }
}

/// Length of an MQTT packet behind its first byte: at most four bytes, seven bits each, the lowest first.
fn packet_length(head: &[u8]) -> Option<u64> {
    let digits = head.get(1..).filter(|digits| !digits.is_empty())?;
    let continues = digits.last().is_some_and(|last| last & 0x80 != 0);
    let length = |digits: &[u8]| {
        digits
            .iter()
            .rev()
            .fold(0, |sum, digit| sum << 7 | u64::from(digit & 0x7F))
    };
    (!continues || digits.len() == 4).then(|| length(digits))
}

/// Length of a record of TLS behind its type and version.
fn record_length(head: &[u8]) -> Option<u64> {
    head.get(3..5).map(number)
}

/// Length of a frame of WebSocket: seven bits, or the two or eight bytes that follow; then the mask, if there is one.
fn web_socket_length(head: &[u8]) -> Option<u64> {
    let second = *head.get(1)?;
    let (short, mask) = (second & 0x7F, usize::from(second >> 7) * 4);
    let long = match short {
        126 => 2,
        127 => 8,
        _ => 0,
    };
    let extended = head.get(2..2 + long).filter(|_| head.len() == 2 + long + mask)?;
    Some(if long == 0 { short.into() } else { number(extended) })
}

fn number(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0, |sum, byte| sum << 8 | u64::from(*byte))
}

#[cfg(test)]
mod tests {
    use super::FrameEnd::{Begun, Continued, Whole};
    use super::*;

    /// A frame of that protocol with this body.
    fn packet(body: usize) -> Vec<u8> {
        let head = if body < 128 {
            vec![0x30, body as u8]
        } else {
            vec![0x30, (body & 0x7F) as u8 | 0x80, (body >> 7) as u8]
        };
        [head, vec![0xFF; body]].concat()
    }

    fn record(body: usize) -> Vec<u8> {
        let length = (body as u16).to_be_bytes();
        [vec![0x17, 3, 3, length[0], length[1]], vec![0xFF; body]].concat()
    }

    fn web_socket(first: u8, body: &[u8]) -> Vec<u8> {
        let length = (body.len() as u16).to_be_bytes();
        let head = if body.len() < 126 {
            vec![first, length[1]]
        } else {
            vec![first, 126, length[0], length[1]]
        };
        [head, body.to_vec()].concat()
    }

    fn frames(proxy: bool, tls: bool, web_socket: bool) -> PacketFrames {
        PacketFrames::new(Carrier { proxy, tls, web_socket })
    }

    /// Passes the bytes in pieces that end at these places; returns how each ends.
    fn cut(mut frames: PacketFrames, bytes: &[u8], places: &[usize]) -> Vec<FrameEnd> {
        let bounds = [&[0], places, &[bytes.len()]].concat();
        let pieces = bounds.windows(2).map(|bounds| &bytes[bounds[0]..bounds[1]]);
        pieces.map(|piece| frames.pass(piece)).collect()
    }

    #[test]
    fn a_frame_is_incomplete_until_its_last_byte() {
        for (tls, frame) in [(false, packet as fn(usize) -> Vec<u8>), (true, record)] {
            for body in [0, 1, 127, 128, 3000] {
                let (one, two) = (frame(body), [frame(body), frame(7)].concat());
                for place in 1..one.len() {
                    assert_eq!(cut(frames(false, tls, false), &two, &[place]), [Begun, Whole]);
                }
                let last = two.len() - 1;
                let start = one.len();
                assert_eq!(cut(frames(false, tls, false), &two, &[start]), [Whole, Whole]);
                assert_eq!(
                    cut(frames(false, tls, false), &two, &[start + 1, last]),
                    [Begun, Continued, Whole]
                );
                assert_eq!(
                    cut(frames(false, tls, false), &two, &[start - 1, start + 1]),
                    [Begun, Begun, Whole],
                    "the end of one and the begin of the next"
                );
            }
        }
    }

    #[test]
    fn heads_of_http_precede_the_frames() {
        let head = b"HTTP/1.1 200 OK\r\nX: \r\r\n\r\n";
        let proxied = [&head[..], &record(40), &record(40)].concat();
        let places = [3, head.len() - 1, head.len() + 10];
        assert_eq!(
            cut(frames(true, true, false), &proxied, &places),
            [Whole, Whole, Begun, Whole]
        );
        let both = [&head[..], head, &web_socket(0x82, &packet(5))].concat();
        let places = [head.len(), 2 * head.len(), 2 * head.len() + 1];
        assert_eq!(
            cut(frames(true, false, true), &both, &places),
            [Whole, Whole, Begun, Whole]
        );
    }

    #[test]
    fn a_packet_may_extend_over_several_frames_of_web_socket() {
        let head = b"HTTP/1.1 101 Switching Protocols\r\n\r\n";
        let packet = packet(300);
        let (first, rest) = packet.split_at(200);
        let parts = [
            &head[..],
            &web_socket(0x02, first),
            &web_socket(0x89, b"ping"),
            &web_socket(0x80, rest),
        ];
        let mut frames = frames(false, false, true);
        let ends: Vec<FrameEnd> = parts.iter().map(|part| frames.pass(part)).collect();
        assert_eq!(ends, [Whole, Begun, Continued, Whole]);
    }
}
