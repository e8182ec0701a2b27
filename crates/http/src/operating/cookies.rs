//! Cookies: the session, and the mark of a browser that has logged in before.

use axum::http::header::{self, HeaderMap, HeaderValue};
use ring::hmac;

use super::super::users::User;
use drivegate_core::hex;

/// Time for which a browser stays known, s.
const KNOWN: u32 = 90 * 86_400;

/// The cookies of this gateway on a connection with TLS or without.
#[derive(Debug, Clone)]
pub(crate) struct Cookies {
    session: String,
    known: String,
    tls: bool,
}

impl Cookies {
    /// Names of the cookies of this gateway. They contain its name because browsers share cookies between all ports
    /// of a machine, where several gateways may run.
    pub(crate) fn of(gateway: &str, tls: bool) -> Cookies {
        let prefix = if tls { "__Host-" } else { "" };
        Cookies {
            session: format!("{prefix}drivegate-{gateway}"),
            known: format!("{prefix}drivegate-{gateway}-known"),
            tls,
        }
    }

    /// The value of the session cookie in a request.
    pub(super) fn session(&self, headers: &HeaderMap) -> Option<String> {
        find(headers, &self.session)
    }

    /// The value of the browser cookie in a request.
    pub(super) fn known(&self, headers: &HeaderMap) -> Option<String> {
        find(headers, &self.known)
    }

    /// Sets the session's cookie; the cookie ends with the browser or with the session.
    pub(super) fn set_session(&self, value: &str) -> Option<HeaderValue> {
        self.set(&self.session, value, "")
    }

    /// The header that removes the session cookie.
    pub(super) fn clear_session(&self) -> Option<HeaderValue> {
        self.set(&self.session, "", "; Max-Age=0")
    }

    /// Marks the browser as one from which `user` has logged in.
    pub(super) fn set_known(&self, user: &User, number: &[u8; 16]) -> Option<HeaderValue> {
        let number = hex::encode(number);
        let value = format!("{number}.{}", hex::encode(sign(user, &number).as_ref()));
        self.set(&self.known, &value, &format!("; Max-Age={KNOWN}"))
    }

    fn set(&self, name: &str, value: &str, more: &str) -> Option<HeaderValue> {
        let secure = if self.tls { "; Secure" } else { "" };
        let text = format!("{name}={value}; Path=/; HttpOnly; SameSite=Strict{secure}{more}");
        HeaderValue::from_str(&text).ok()
    }
}

/// The number of a browser that is known for `user`. The key is the user's own hash, salt included: another password makes
/// all browsers unknown, a restart does not.
pub(super) fn known_as<'m>(mark: &'m str, user: &User) -> Option<&'m str> {
    let (number, tag) = mark.split_once('.')?;
    hmac::verify(&key(user), number.as_bytes(), &hex::decode(tag)?).ok()?;
    Some(number)
}

fn sign(user: &User, number: &str) -> hmac::Tag {
    hmac::sign(&key(user), number.as_bytes())
}

fn key(user: &User) -> hmac::Key {
    hmac::Key::new(hmac::HMAC_SHA256, user.to_string().as_bytes())
}

/// The value of the cookie with this name; `None` if there are several, because a foreign page may have set one of them.
fn find(headers: &HeaderMap, name: &str) -> Option<String> {
    let all = headers
        .get_all(header::COOKIE)
        .iter()
        .filter_map(|value| value.to_str().ok());
    let pairs = all
        .flat_map(|text| text.split(';'))
        .filter_map(|pair| pair.trim().split_once('='));
    let mut values = pairs.filter(|(key, _)| *key == name).map(|(_, value)| value);
    match (values.next(), values.next()) {
        (Some(value), None) => Some(value.to_string()),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cookie_is_found_if_it_is_the_only_one_of_its_name() {
        let cookies = Cookies::of("hall", true);
        let of = |lines: &[&str]| {
            let mut headers = HeaderMap::new();
            for line in lines {
                headers.append(header::COOKIE, HeaderValue::from_str(line).unwrap());
            }
            cookies.session(&headers)
        };
        assert_eq!(of(&["a=b; __Host-drivegate-hall=x"]).as_deref(), Some("x"));
        assert_eq!(of(&["a=b", "__Host-drivegate-hall=x;c=d"]).as_deref(), Some("x"));
        assert_eq!(of(&["__Host-drivegate-hall=x; __Host-drivegate-hall=y"]), None);
        assert_eq!(of(&["__Host-drivegate-hall=x", "__Host-drivegate-hall=x"]), None);
        assert_eq!(of(&["drivegate-hall=x; __Host-drivegate-halls=y"]), None);
        assert_eq!(of(&[]), None);
    }

    #[test]
    fn cookies_are_out_of_reach_of_scripts_and_other_sites() {
        let text = |value: Option<HeaderValue>| value.unwrap().to_str().unwrap().to_string();
        let rest = "Path=/; HttpOnly; SameSite=Strict";
        assert_eq!(
            text(Cookies::of("hall", true).set_session("s")),
            format!("__Host-drivegate-hall=s; {rest}; Secure")
        );
        assert_eq!(
            text(Cookies::of("hall", false).clear_session()),
            format!("drivegate-hall=; {rest}; Max-Age=0")
        );
    }

    #[test]
    fn a_browser_is_known_for_one_user_and_one_password() {
        let [alice, bob, other] = [
            ("alice", "correct horse"),
            ("bob", "correct horse"),
            ("alice", "battery staple"),
        ]
        .map(|(name, password)| User::new(name, password).unwrap());
        let header = Cookies::of("hall", false).set_known(&alice, &[7; 16]).unwrap();
        let mark = header.to_str().unwrap().split(['=', ';']).nth(1).unwrap();
        assert_eq!(known_as(mark, &alice), Some("07".repeat(16).as_str()));
        assert_eq!(known_as(mark, &bob), None);
        assert_eq!(known_as(mark, &other), None);
        let forged = mark.replacen('7', "8", 1);
        for wrong in [&forged, "", ".", "07.", "ä.ä", &mark[1..], &mark[..mark.len() - 1]] {
            assert_eq!(known_as(wrong, &alice), None, "{wrong}");
        }
    }
}
