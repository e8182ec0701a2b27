//! The server side of the telnet COM port option (RFC 2217), for programs that open a port of this gateway.
//!
//! Settings of the program are confirmed and have no effect: baud rate and format of the line are not the program's.

use super::com_port::{
    ANSWER, BINARY, COM_PORT, PURGE, SET_BAUD, SET_CONTROL, SET_DATA_BITS, SET_LINE_STATE_MASK, SET_MODEM_STATE_MASK,
    SET_PARITY, SET_STOP_BITS, SUPPRESS_GO_AHEAD, parity_code, set,
};
use super::telnet::{Command, Decoder, IAC, Verb};
use drivegate_proto::LineFormat;

const SIGNATURE: u8 = 0;
const NOTIFY_MODEM_STATE: u8 = 107;
/// Reported modem state: carrier, data set ready and clear to send. Some programs send nothing without them.
const MODEM_STATE: u8 = 0xB0;
/// Name of the server, for programs that request it.
const NAME: &[u8] = b"drivegate";
/// The negotiation of each option, sent once.
const OPTIONS: [(Verb, u8); 5] = [
    (Verb::Do, COM_PORT),
    (Verb::Will, BINARY),
    (Verb::Do, BINARY),
    (Verb::Will, SUPPRESS_GO_AHEAD),
    (Verb::Do, SUPPRESS_GO_AHEAD),
];

/// The server side of a program's connection.
#[derive(Debug)]
pub struct ServedPort {
    format: LineFormat,
    decoder: Decoder,
    /// Whether the program already knows that the server has the COM port option.
    has_com_port: bool,
}

impl ServedPort {
    /// A connection to a line of that format, and the first bytes for the program.
    pub fn new(format: LineFormat) -> (ServedPort, Vec<u8>) {
        let first = OPTIONS.iter().flat_map(|(verb, option)| [IAC, verb.byte(), *option]);
        let port = ServedPort {
            format,
            decoder: Decoder::default(),
            has_com_port: false,
        };
        (port, first.collect())
    }

    /// Appends the data in `bytes` to `data`; returns the bytes that must be sent to the program.
    pub fn take(&mut self, bytes: &[u8], data: &mut Vec<u8>) -> Vec<u8> {
        let mut commands = Vec::new();
        self.decoder.take(bytes, data, &mut commands);
        let mut replies = Vec::new();
        for command in commands {
            match command {
                Command::Option(verb, option) => self.option(verb, option, &mut replies),
                Command::Sub(content) => self.asked(&content, &mut replies),
            }
        }
        replies
    }

    fn option(&mut self, verb: Verb, option: u8, replies: &mut Vec<u8>) {
        let own = |verb| OPTIONS.contains(&(verb, option));
        match verb {
            // These are replies to the initial negotiation.
            Verb::Will if own(Verb::Do) => {}
            Verb::Do if own(Verb::Will) => {}
            Verb::Do if option == COM_PORT => {
                if !std::mem::replace(&mut self.has_com_port, true) {
                    replies.extend([IAC, Verb::Will.byte(), option]);
                }
            }
            Verb::Will => replies.extend([IAC, Verb::Dont.byte(), option]),
            Verb::Do => replies.extend([IAC, Verb::Wont.byte(), option]),
            Verb::Dont | Verb::Wont => {}
        }
    }

    /// A setting is confirmed as requested. The value 0 is a question; the answer is the present setting of the line.
    fn asked(&self, content: &[u8], replies: &mut Vec<u8>) {
        let [COM_PORT, command, value @ ..] = content else {
            return;
        };
        let format = &self.format;
        let answered = ANSWER + (*command).min(ANSWER);
        let confirm = |own: u8| match value {
            [0] | [] => vec![own],
            [asked, ..] => vec![*asked],
        };
        match (*command, value) {
            (SIGNATURE, []) => set(replies, answered, NAME),
            (SET_BAUD, [0, 0, 0, 0]) => set(replies, answered, &format.baud.to_be_bytes()),
            (SET_BAUD, [_, _, _, _]) => set(replies, answered, value),
            (SET_DATA_BITS, _) => set(replies, answered, &confirm(format.data_bits)),
            (SET_PARITY, _) => set(replies, answered, &confirm(parity_code(format.parity))),
            (SET_STOP_BITS, _) => set(replies, answered, &confirm(format.stop_bits)),
            (SET_CONTROL, [asked]) => set(replies, answered, &[control(*asked)]),
            (SET_LINE_STATE_MASK | PURGE, [asked]) => set(replies, answered, &[*asked]),
            (SET_MODEM_STATE_MASK, [asked]) => {
                set(replies, answered, &[*asked]);
                set(replies, NOTIFY_MODEM_STATE, &[MODEM_STATE & asked]);
            }
            _ => {}
        }
    }
}

/// The answer to a request for the state of flow control, break, DTR or RTS; anything else is confirmed.
fn control(asked: u8) -> u8 {
    match asked {
        // The answers mean: no flow control; no break; DTR on; RTS on; no inbound flow control.
        0 => 1,
        4 => 6,
        7 => 8,
        10 => 11,
        13 => 14,
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::com_port::{Session, Settings, State};
    use super::super::telnet::{SB, SE, escape};
    use super::*;
    use crate::options::Level;

    fn format() -> LineFormat {
        LineFormat::new(9600, "8N1").unwrap()
    }

    fn sub(content: &[u8]) -> Vec<u8> {
        [&[IAC, SB, COM_PORT], content, &[IAC, SE]].concat()
    }

    /// drivegate's own client can negotiate with this server, whatever it requests, and receives the expected replies.
    #[test]
    fn the_client_of_this_program_settles_with_it() {
        let settings = Settings {
            format: LineFormat::new(115_200, "7E2").unwrap(),
            rts: Level::On,
            dtr: Level::Off,
        };
        let (mut server, mut to_client) = ServedPort::new(format());
        let (mut client, mut to_server) = Session::new(settings);
        let (mut asked, mut heard) = (Vec::new(), Vec::new());
        for _ in 0..4 {
            let replies = server.take(&std::mem::take(&mut to_server), &mut asked);
            to_client.extend(replies);
            to_server = client.take(&std::mem::take(&mut to_client), &mut heard);
        }
        assert_eq!((client.state(), client.took().as_str()), (&State::Ready, "115200 7E2"));
        assert!(asked.is_empty() && heard.is_empty());
        assert!(to_server.is_empty() && to_client.is_empty(), "nobody talks without end");
        server.take(&escape(&[1, 3, 255, 255, 0]), &mut asked);
        assert_eq!(asked, [1, 3, 255, 255, 0]);
    }

    #[test]
    fn questions_are_answered_with_what_the_line_has() {
        let (mut server, _) = ServedPort::new(format());
        for (question, answer) in [
            (&[1, 0, 0, 0, 0][..], &[101, 0, 0, 37, 128][..]),
            (&[2, 0], &[102, 8]),
            (&[3, 0], &[103, 1]),
            (&[4, 0], &[104, 1]),
            (&[5, 7], &[105, 8]),
            (&[0], &[&[100][..], NAME].concat()),
        ] {
            assert_eq!(
                server.take(&sub(question), &mut Vec::new()),
                sub(answer),
                "{question:?}"
            );
        }
        let asked = [&[IAC, SB, COM_PORT, 11, IAC, IAC][..], &[IAC, SE]].concat();
        let doubled = [
            &[IAC, SB, COM_PORT, 111, IAC, IAC, IAC, SE][..],
            &sub(&[107, MODEM_STATE]),
        ]
        .concat();
        assert_eq!(server.take(&asked, &mut Vec::new()), doubled);
    }

    proptest! {
        /// Even a hostile program gets only few bytes in reply to its own.
        #[test]
        fn any_program_is_borne(bytes in prop::collection::vec(prop_oneof![Just(IAC), 240..=255u8, Just(44u8), 0..14u8, any::<u8>()], 0..400)) {
            let (mut server, _) = ServedPort::new(format());
            let mut data = Vec::new();
            let replies = server.take(&bytes, &mut data);
            prop_assert!(replies.len() <= 3 * bytes.len() + 20);
            prop_assert!(data.len() <= bytes.len());
        }
    }
}
