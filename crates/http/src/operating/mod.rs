//! Users who may command over HTTP, their sessions, and how a request is authenticated.
//!
//! A browser logs in and then has a cookie; a program sends user and password with each request (HTTP Basic). A
//! request that changes something must also come from this gateway's own page or from no page at all
//! (`is_own_origin`), and in a session must repeat its token (`check_csrf`). `sessions` and `throttle` are pure.

mod asker;
mod commands;
pub(super) mod cookies;
mod drills;
mod hold;
mod login;
pub(super) mod parameters;
mod paths;
mod record;
mod restart;
mod sessions;
pub(super) mod state;
mod stop_all;
mod throttle;
mod verifier;

pub(super) use self::asker::Viewer;
pub(super) use self::commands::{Commandable, command, commands_of, heartbeat};
pub(super) use self::drills::{arm_drill, drill, drills, end_drill, start_drill};
pub(super) use self::hold::{hold, hold_of};
pub(super) use self::login::{SessionReply, log_in, log_out, session};
pub(super) use self::paths::{is_command, is_operating, is_session, may_change};
pub(super) use self::record::record;
pub use self::state::basic_authorization;
pub(super) use self::state::{Credentials, Operating};
pub(super) use self::stop_all::stop;
