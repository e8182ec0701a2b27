//! The COM port option of telnet (RFC 2217): the client agrees on it with the server, sets baud rate and format,
//! and receives the settings that the server uses.

use super::telnet::{Command, Decoder, IAC, SB, SE, Verb, escape};
use crate::options::Level;
use drivegate_proto::{LineFormat, Parity};

pub(super) const BINARY: u8 = 0;
pub(super) const SUPPRESS_GO_AHEAD: u8 = 3;
pub(super) const COM_PORT: u8 = 44;

pub(super) const SET_BAUD: u8 = 1;
pub(super) const SET_DATA_BITS: u8 = 2;
pub(super) const SET_PARITY: u8 = 3;
pub(super) const SET_STOP_BITS: u8 = 4;
pub(super) const SET_CONTROL: u8 = 5;
pub(super) const SET_LINE_STATE_MASK: u8 = 10;
pub(super) const SET_MODEM_STATE_MASK: u8 = 11;
pub(super) const PURGE: u8 = 12;
/// The server's reply to a command has the number of the command plus this value.
pub(super) const ANSWER: u8 = 100;

const NO_FLOW_CONTROL: u8 = 1;
const DTR: (u8, u8) = (8, 9);
const RTS: (u8, u8) = (11, 12);
const BOTH_BUFFERS: u8 = 3;

/// The settings of the port at the server.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Settings {
    pub(crate) format: LineFormat,
    pub(crate) rts: Level,
    pub(crate) dtr: Level,
}

/// The progress of the negotiation.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum State {
    /// The server has not yet answered whether it supports the option.
    Asked,
    /// The server has the option; replies to settings are missing.
    Setting,
    /// All settings are made; from now on, bytes from the server are data of the line.
    Ready,
    /// The port cannot be used: the reason and the remedy.
    Refused(&'static str),
}

/// The negotiation of a connection.
#[derive(Debug)]
pub(crate) struct Session {
    settings: Settings,
    decoder: Decoder,
    state: State,
    /// Settings without an answer so far: the command, and the name of the setting.
    missing: Vec<(u8, &'static str)>,
    /// Settings that the server confirmed: baud rate, data bits, parity, stop bits, as in the answers.
    took: [u32; 4],
}

impl Session {
    /// A session and the first bytes for the server.
    pub(crate) fn new(settings: Settings) -> (Session, Vec<u8>) {
        let mut first = Vec::new();
        for (verb, option) in [
            (Verb::Will, COM_PORT),
            (Verb::Will, BINARY),
            (Verb::Do, BINARY),
            (Verb::Will, SUPPRESS_GO_AHEAD),
            (Verb::Do, SUPPRESS_GO_AHEAD),
        ] {
            first.extend([IAC, verb.byte(), option]);
        }
        let session = Session {
            settings,
            decoder: Decoder::default(),
            state: State::Asked,
            missing: Vec::new(),
            took: [0; 4],
        };
        (session, first)
    }

    pub(crate) fn state(&self) -> &State {
        &self.state
    }

    /// Names of the settings that the server has not answered.
    pub(crate) fn missing(&self) -> String {
        let names: Vec<&str> = self.missing.iter().map(|(_, name)| *name).collect();
        names.join(", ")
    }

    /// The format that the server confirmed for the port.
    pub(crate) fn took(&self) -> String {
        let [baud, data_bits, parity, stop_bits] = self.took;
        let parity = match parity {
            1 => 'N',
            2 => 'O',
            3 => 'E',
            _ => '?',
        };
        format!("{baud} {data_bits}{parity}{stop_bits}")
    }

    /// Appends the data in `bytes` to `data`; returns the bytes that must be sent to the server.
    pub(crate) fn take(&mut self, bytes: &[u8], data: &mut Vec<u8>) -> Vec<u8> {
        let mut commands = Vec::new();
        self.decoder.take(bytes, data, &mut commands);
        let mut replies = Vec::new();
        for command in commands {
            match command {
                Command::Option(verb, option) => self.option(verb, option, &mut replies),
                Command::Sub(content) => self.answered(&content),
            }
        }
        replies
    }

    fn option(&mut self, verb: Verb, option: u8, replies: &mut Vec<u8>) {
        match (verb, option) {
            (Verb::Do, COM_PORT) => self.agreed(replies),
            (Verb::Will, COM_PORT) => {
                if self.state == State::Asked {
                    replies.extend([IAC, Verb::Do.byte(), COM_PORT]);
                }
                self.agreed(replies);
            }
            (Verb::Dont, COM_PORT) if self.state != State::Ready => {
                self.state = State::Refused(
                    "the device server has no remote port setup (RFC 2217); set baud rate and format there, and write tcp:// with its raw port",
                );
            }
            (Verb::Dont | Verb::Wont, BINARY) => {
                self.state = State::Refused(
                    "the device server does not pass all bytes through (telnet option BINARY); use its raw port, with tcp://",
                );
            }
            // Replies to the initial offers and requests.
            (Verb::Do | Verb::Will, BINARY | SUPPRESS_GO_AHEAD) => {}
            (Verb::Do, _) => replies.extend([IAC, Verb::Wont.byte(), option]),
            (Verb::Will, _) => replies.extend([IAC, Verb::Dont.byte(), option]),
            (Verb::Dont | Verb::Wont, _) => {}
        }
    }

    fn agreed(&mut self, replies: &mut Vec<u8>) {
        if self.state != State::Asked {
            return;
        }
        self.state = State::Setting;
        let Settings { format, rts, dtr } = self.settings;
        let parity = parity_code(format.parity);
        let level = |level, (on, off)| match level {
            Level::Driver => None,
            Level::On => Some(on),
            Level::Off => Some(off),
        };
        set(replies, SET_BAUD, &format.baud.to_be_bytes());
        set(replies, SET_DATA_BITS, &[format.data_bits]);
        set(replies, SET_PARITY, &[parity]);
        set(replies, SET_STOP_BITS, &[format.stop_bits]);
        self.missing = vec![
            (SET_BAUD, "baud rate"),
            (SET_DATA_BITS, "data bits"),
            (SET_PARITY, "parity"),
            (SET_STOP_BITS, "stop bits"),
        ];
        set(replies, SET_CONTROL, &[NO_FLOW_CONTROL]);
        for value in [level(dtr, DTR), level(rts, RTS)].into_iter().flatten() {
            set(replies, SET_CONTROL, &[value]);
        }
        // Notifications are switched off, and the bytes that the port received before are discarded: only data and
        // answers are needed.
        set(replies, SET_LINE_STATE_MASK, &[0]);
        set(replies, SET_MODEM_STATE_MASK, &[0]);
        set(replies, PURGE, &[BOTH_BUFFERS]);
    }

    fn answered(&mut self, content: &[u8]) {
        let [COM_PORT, command, value @ ..] = content else {
            return;
        };
        let Some(command) = command.checked_sub(ANSWER) else {
            return;
        };
        let number = match value {
            [a, b, c, d] => u32::from_be_bytes([*a, *b, *c, *d]),
            [one] => u32::from(*one),
            _ => return,
        };
        let Some(took) = self.took.get_mut(usize::from(command).wrapping_sub(1)) else {
            return;
        };
        *took = number;
        self.missing.retain(|(missing, _)| *missing != command);
        if self.state == State::Setting && self.missing.is_empty() {
            self.state = State::Ready;
        }
    }
}

/// The number of a parity in commands and answers.
pub(super) fn parity_code(parity: Parity) -> u8 {
    match parity {
        Parity::None => 1,
        Parity::Odd => 2,
        Parity::Even => 3,
    }
}

/// Appends a command with its value, or the reply to a command.
pub(super) fn set(replies: &mut Vec<u8>, command: u8, value: &[u8]) {
    replies.extend([IAC, SB, COM_PORT, command]);
    replies.extend(escape(value));
    replies.extend([IAC, SE]);
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn settings(baud: u32, format: &str) -> Settings {
        Settings {
            format: LineFormat::new(baud, format).unwrap(),
            rts: Level::Driver,
            dtr: Level::Driver,
        }
    }

    fn sub(content: &[u8]) -> Vec<u8> {
        [&[IAC, SB, COM_PORT], content, &[IAC, SE]].concat()
    }

    /// Whether `part` is contained in `whole`.
    fn has(whole: &[u8], part: &[u8]) -> bool {
        whole.windows(part.len()).any(|window| window == part)
    }

    #[test]
    fn the_port_is_set_as_soon_as_the_server_agrees() {
        let (mut session, first) = Session::new(settings(19_200, "8E1"));
        assert!(has(&first, &[IAC, 251, 44]), "WILL COM-PORT-OPTION");
        let mut data = Vec::new();
        assert!(session.take(&[IAC, 253, 0, IAC, 251, 0], &mut data).is_empty());
        assert_eq!(session.state(), &State::Asked);
        let sent = session.take(&[IAC, 253, 44], &mut data);
        for request in [&[1, 0, 0, 75, 0][..], &[2, 8], &[3, 3], &[4, 1], &[5, 1], &[12, 3]] {
            assert!(has(&sent, &sub(request)), "{request:?} in {sent:?}");
        }
        assert!(session.take(&[IAC, 253, 44], &mut data).is_empty(), "only once");
        assert_eq!(session.missing(), "baud rate, data bits, parity, stop bits");
        for answer in [&[101, 0, 0, 75, 0][..], &[102, 8], &[103, 3], &[104, 1]] {
            assert_eq!(session.state(), &State::Setting);
            session.take(&sub(answer), &mut data);
        }
        assert_eq!(session.state(), &State::Ready);
        assert_eq!(session.took(), session.settings.format.to_string());
        session.take(&[1, 2, IAC, IAC], &mut data);
        assert_eq!(data, [1, 2, 255]);
    }

    #[test]
    fn a_server_that_offers_the_option_is_asked_for_it() {
        let (mut session, _) = Session::new(settings(9600, "8N1"));
        let sent = session.take(&[IAC, 251, 44], &mut Vec::new());
        assert!(
            sent.starts_with(&[IAC, 253, 44]) && has(&sent, &sub(&[4, 1])),
            "{sent:?}"
        );
    }

    #[test]
    fn levels_are_set_where_they_are_chosen() {
        let chosen = Settings {
            rts: Level::On,
            dtr: Level::Off,
            ..settings(9600, "8N1")
        };
        let sent = Session::new(chosen).0.take(&[IAC, 253, 44], &mut Vec::new());
        assert!(has(&sent, &sub(&[5, 11])) && has(&sent, &sub(&[5, 9])), "{sent:?}");
        let sent = Session::new(settings(9600, "8N1"))
            .0
            .take(&[IAC, 253, 44], &mut Vec::new());
        assert!((8..=12).all(|value| !has(&sent, &sub(&[5, value]))), "{sent:?}");
    }

    #[test]
    fn what_the_server_settled_on_is_told() {
        let (mut session, _) = Session::new(settings(115_200, "7O2"));
        let answers = [
            sub(&[101, 0, 0, 37, 128]),
            sub(&[102, 8]),
            sub(&[103, 1]),
            sub(&[104, 1]),
        ]
        .concat();
        session.take(&[[IAC, 253, 44].as_slice(), &answers].concat(), &mut Vec::new());
        assert_eq!((session.state(), session.took().as_str()), (&State::Ready, "9600 8N1"));
    }

    #[test]
    fn a_server_without_the_option_or_without_clean_bytes() {
        for (refusal, remedy) in [
            ([IAC, 254, 44], "tcp://"),
            ([IAC, 254, 0], "raw port"),
            ([IAC, 252, 0], "raw port"),
        ] {
            let (mut session, _) = Session::new(settings(9600, "8N1"));
            session.take(&refusal, &mut Vec::new());
            assert!(matches!(session.state(), State::Refused(why) if why.contains(remedy)));
        }
    }

    #[test]
    fn other_options_are_refused_once_each() {
        let (mut session, _) = Session::new(settings(9600, "8N1"));
        let replies = session.take(&[IAC, 251, 1, IAC, 253, 31, IAC, 252, 1, IAC, 254, 31], &mut Vec::new());
        assert_eq!(replies, [IAC, 254, 1, IAC, 252, 31]);
    }

    proptest! {
        /// A hostile server gets few bytes for its own, so that neither end can be made to answer endlessly.
        #[test]
        fn any_server_is_borne(bytes in prop::collection::vec(prop_oneof![Just(IAC), 240..=255u8, Just(44u8), any::<u8>()], 0..400)) {
            let (mut session, _) = Session::new(settings(9600, "8N1"));
            let mut data = Vec::new();
            let replies = session.take(&bytes, &mut data);
            prop_assert!(replies.len() <= bytes.len() + 120);
            prop_assert!(data.len() <= bytes.len());
        }
    }
}
