use axum::http::HeaderValue;
use drivegate_north::NorthState;

use super::super::paths::is_operating;
use super::*;

fn headers(lines: &[(&str, &str)]) -> HeaderMap {
    let mut headers = HeaderMap::new();
    for (name, value) in lines {
        let name = header::HeaderName::from_bytes(name.as_bytes()).unwrap();
        headers.append(name, HeaderValue::from_str(value).unwrap());
    }
    headers
}

#[test]
fn own_origins() {
    for (host, origin) in [
        ("localhost:9488", "http://localhost:9488"),
        ("LOCALHOST:9488", "http://localhost:9488"),
        ("gateway", "http://gateway"),
        ("gateway:80", "http://gateway"),
        ("gateway", "https://gateway:443"),
        ("[::1]:9488", "http://[::1]:9488"),
    ] {
        assert_eq!(
            is_own_origin(&headers(&[("host", host), ("origin", origin)])),
            Ok(()),
            "{host} {origin}"
        );
    }
    for origin in [
        "",
        "null",
        "http://",
        "http://evil.example",
        "http://localhost",
        "http://localhost:9489",
        "http://localhost:94880",
        "http://localhost:9488.evil.example",
        "http://evil.example#localhost:9488",
        "ftp://localhost:9488",
        "localhost:9488",
    ] {
        let of = headers(&[("host", "localhost:9488"), ("origin", origin)]);
        assert_eq!(is_own_origin(&of), Err(Denied::OtherOrigin), "{origin}");
    }
    for (site, own) in [
        ("same-origin", true),
        ("none", true),
        ("same-site", false),
        ("cross-site", false),
    ] {
        let of = headers(&[("host", "gateway"), ("sec-fetch-site", site)]);
        assert_eq!(is_own_origin(&of).is_ok(), own, "{site}");
    }
    assert_eq!(is_own_origin(&headers(&[("host", "gateway")])), Ok(()), "a program");
}

#[test]
fn basic_credentials() {
    let given = |lines: &[(&str, &str)]| basic(&headers(lines)).map(|given| (given.user, given.password));
    let alice = |password: &str| Some(("alice".to_string(), password.to_string()));
    assert_eq!(given(&[("authorization", "Basic YWxpY2U6YTpi")]), alice("a:b"));
    assert_eq!(given(&[("authorization", "basic  YWxpY2U6w6Q=")]), alice("ä"));
    assert_eq!(given(&[("authorization", "Basic YWxpY2U6")]), alice(""));
    let long = format!("Basic {}", "YWxp".repeat(300));
    for bad in [
        "Basic",
        "Basic YWxpY2U=",
        "Basic ?",
        "Basic /w==",
        "Bearer YWxpY2U6YTpi",
        &long,
    ] {
        assert_eq!(given(&[("authorization", bad)]), None, "{bad}");
    }
    assert_eq!(
        given(&[
            ("authorization", "Basic YWxpY2U6YTpi"),
            ("authorization", "Basic YWxpY2U6YTpi")
        ]),
        None
    );
    assert_eq!(given(&[]), None);
}

#[test]
fn paths_of_commands() {
    for path in [
        "/api/v1/login",
        "/api/v1/logout",
        "/api/v1/session",
        "/api/v1/drives/pump-1/commands",
        "/api/v1/drives/pump-1/heartbeat",
        "/assets/operate.js",
    ] {
        assert!(is_operating(path), "{path}");
    }
    for path in [
        "/",
        "/metrics",
        "/api/v1/drives",
        "/api/v1/drives/commands",
        "/api/v1/drives/a/b/commands",
        "/api/v1/drives/pump-1/commands/",
        "/api/v1/login/",
        "/assets/page.js",
    ] {
        assert!(!is_operating(path), "{path}");
    }
}

#[tokio::test]
async fn users_come_and_go() {
    let made = User::new("alice", "correct horse").unwrap();
    let operating = Operating::new(&NorthState::default());
    operating.set_users(Some(Users::default()));
    let given = Credentials {
        user: "alice".to_string(),
        password: "correct horse".to_string(),
    };
    let address = [192, 0, 2, 1].into();
    let source = Source::of(address);
    assert_eq!(operating.verified(&given, address, source).await, Err(Denied::Wrong));
    operating.set_users(Some(Users::parse(&made.to_string()).unwrap()));
    assert_eq!(
        operating.verified(&given, address, source).await.as_deref(),
        Ok("alice")
    );
    operating.set_users(None);
    assert_eq!(
        operating.verified(&given, address, source).await,
        Err(Denied::NotLoggedIn)
    );
}

/// Each way in which a user loses the right to command, and what ends with it.
#[tokio::test]
async fn the_right_of_a_user_is_that_of_the_file_of_now() {
    let user = |name: &str, password: &str| User::new(name, password).unwrap().to_string();
    let (alice, bob) = (user("alice", "correct horse"), user("bob", "correct horse"));
    let users = |lines: &[&String]| {
        let lines: Vec<&str> = lines.iter().map(|line| line.as_str()).collect();
        Some(Users::parse(&lines.join("\n")).unwrap())
    };
    let table = [
        ("the same", users(&[&alice, &bob]), true),
        ("another one is removed", users(&[&alice]), true),
        ("removed", users(&[&bob]), false),
        (
            "another password",
            users(&[&user("alice", "another horse"), &bob]),
            false,
        ),
        (
            "the same password with another salt",
            users(&[&user("alice", "correct horse")]),
            false,
        ),
        ("commands are off", None, false),
    ];
    for (what, then, stays) in table {
        let operating = Operating::new(&NorthState::default());
        operating.set_users(users(&[&alice, &bob]));
        let basic = basic_authorization("alice:correct horse");
        let cookies = Cookies::of("hall", false);
        let reached = Reached::within(None, None);
        let with_password = headers(&[("authorization", &basic)]);
        let by_password = operating.operator(&with_password, &cookies, &reached).await.unwrap();
        let (_, cookie) = operating
            .begin(&"alice".into(), [192, 0, 2, 1].into(), Instant::now())
            .unwrap();
        let set = cookies.set_session(&cookie).unwrap();
        let sent = set.to_str().unwrap().split(';').next().unwrap().to_string();
        let by_session = operating
            .operator(&headers(&[("cookie", &sent)]), &cookies, &reached)
            .await;
        let by_session = by_session.unwrap();
        assert!(by_password.is_still_one() && by_session.is_still_one());
        operating.set_users(then);
        assert_eq!(
            (by_password.is_still_one(), by_session.is_still_one()),
            (stays, stays),
            "{what}"
        );
        assert_eq!(by_password.origin().right().allows("line1"), stays, "{what}");
        let again = operating
            .operator(&headers(&[("cookie", &sent)]), &cookies, &reached)
            .await;
        assert_eq!(again.is_ok(), stays, "{what}");
    }
}

#[tokio::test]
async fn a_password_that_was_right_is_not_held_up_by_guesses_at_its_address() {
    let operating = Operating::new(&NorthState::default());
    let user = User::new("alice", "correct horse").unwrap();
    operating.set_users(Some(Users::parse(&user.to_string()).unwrap()));
    let given = |password: &str| Credentials {
        user: "alice".to_string(),
        password: password.to_string(),
    };
    let address = [192, 0, 2, 1].into();
    let source = Source::of(address);
    assert!(
        operating
            .verified(&given("correct horse"), address, source)
            .await
            .is_ok()
    );
    let mut last = Ok("".into());
    for _ in 0..10 {
        last = operating.verified(&given("guess"), address, source).await;
    }
    assert!(matches!(last, Err(Denied::TooMany(_))), "{last:?}");
    assert!(
        operating
            .verified(&given("correct horse"), address, source)
            .await
            .is_ok()
    );
    // The password must be hashed again.
    for (_, until) in operating.state().verified.values_mut() {
        *until = Instant::now();
    }
    assert!(
        operating
            .verified(&given("correct horse"), address, source)
            .await
            .is_ok()
    );
}

#[test]
fn who_did_something_keeps_its_places() {
    let operating = Operating::new(&NorthState::default());
    let user = User::new("alice", "correct horse").unwrap();
    let users = Users::parse(&user.to_string()).unwrap();
    operating.set_users(Some(users.clone()));
    let (now, address) = (Instant::now(), IpAddr::from([192, 0, 2, 1]));
    assert_eq!(operating.authority_at(address, now), Authority::ReadOnly);
    operating.begin(&"alice".into(), address, now).unwrap();
    assert_eq!(operating.authority_at(address, now), Authority::Write);
    assert_eq!(operating.authority_at([192, 0, 2, 2].into(), now), Authority::ReadOnly);
    assert_eq!(
        operating.authority_at(address, now + IDLE),
        Authority::ReadOnly,
        "as long as a session"
    );
    for last in 0..=u8::MAX {
        operating.begin(&"alice".into(), [10, 0, 0, last].into(), now).unwrap();
        operating.begin(&"alice".into(), [10, 0, 1, last].into(), now).unwrap();
    }
    assert_eq!(operating.state().operators.len(), MOST_REMEMBERED);
    operating.set_users(None);
    operating.set_users(Some(users));
    assert!(operating.state().operators.is_empty());
}
