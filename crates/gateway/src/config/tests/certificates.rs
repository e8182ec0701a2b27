//! Messages of `check` about files of certificates and keys that cannot be used, or that peers will refuse. All are made by
//! openssl.

use std::path::Path;
use std::process::Command;

use drivegate_testkit::rows;

use super::load;

const MAKE: &str = r#"
    set -e
    key() { openssl genpkey -algorithm EC -pkeyopt ec_paramgen_curve:${2:-P-256} -out $1.key; }
    by_itself() { openssl req -new -x509 -key $1.key -days 99 -out $1.crt -subj "/CN=$1" "${@:2}"; }
    here='subjectAltName=DNS:hall.local,IP:127.0.0.1'
    leaf='basicConstraints=critical,CA:FALSE'
    key good; by_itself good -addext $here
    key own; by_itself own -addext $here -addext $leaf
    key other
    key nameless; by_itself nameless
    key large P-521; by_itself large -addext $here
    key old; openssl req -new -key old.key -subj /CN=old -out old.csr
    openssl x509 -req -in old.csr -signkey old.key -days 99 -out old.crt
    openssl genrsa -out short.key 1024; by_itself short -addext $here
    openssl pkey -in good.key -aes256 -passout pass:x -out encrypted.key
    openssl ec -in good.key -aes256 -passout pass:x -out encrypted-old.key
    openssl pkey -in good.key -pubout -out public.key
    openssl pkey -in good.key -outform DER -out binary.key
    openssl x509 -in good.crt -outform DER -out binary.crt
    openssl x509 -in good.crt -trustout -out trusted.crt
    openssl crl2pkcs7 -nocrl -certfile good.crt -out bundle.crt
    printf -- '-----BEGIN OPENSSH PRIVATE KEY-----\nAAAA\n-----END OPENSSH PRIVATE KEY-----\n' >ssh.key
    echo nothing >nothing.pem
"#;

fn made() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    let output = Command::new("bash").args(["-c", MAKE]).current_dir(dir.path()).output();
    let output = output.expect("bash starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    dir
}

/// Messages about a certificate and a key, by each section that uses them: HTTP, Modbus TCP, MQTT.
fn said(dir: &Path, certificate: &str, key: &str) -> [Vec<String>; 3] {
    let at = |name: &str| dir.join(name).display().to_string();
    let pair = format!("certificate = {:?}\nkey = {:?}\n", at(certificate), at(key));
    let ca = at("good.crt");
    [
        format!("[http]\nlisten = \"127.0.0.1:9488\"\n{pair}"),
        format!(
            "[modbus_tcp]\nlisten = [\"127.0.0.1:1502\"]\n[modbus_tcp.tls]\nlisten = [\"127.0.0.1:1802\"]\n{pair}client_ca = {ca:?}\n\
             roles = {{ operator = \"control\" }}\n"
        ),
        format!("[mqtt]\nurl = \"mqtts://127.0.0.1\"\nca = {ca:?}\n{pair}"),
    ]
    .map(|text| messages(&text))
}

fn messages(sections: &str) -> Vec<String> {
    let (loaded, _) = load(&format!("[gateway]\nname = \"g\"\n{sections}"));
    let of_files = |text: &String| !text.contains("has no bus") && !text.contains("holds a secret");
    let all = loaded.errors.iter().chain(&loaded.warnings).map(ToString::to_string);
    all.filter(of_files).collect()
}

/// Certificate, key, message about them, and the remedy.
const UNUSABLE: &str = "\
good.crt    | encrypted.key     | it is encrypted, and there is nobody                | openssl pkey -in
good.crt    | encrypted-old.key | it is encrypted, and there is nobody                | openssl pkey -in
good.crt    | good.crt          | contains no private key, but a certificate          | are certificate and key swapped?
good.key    | good.key          | contains no certificate, but a private key          | are certificate and key swapped?
good.crt    | other.key         | the key does not match the certificate              | specify the key of the certificate
good.crt    | public.key        | contains no private key, but a public key           | specify a PEM file
good.crt    | ssh.key           | a key in the format of OpenSSH                      | ssh-keygen -p -m PKCS8
good.crt    | binary.key        | it is binary                                        | openssl pkcs12 -nocerts
binary.crt  | good.key          | it is binary                                        | openssl x509 -in
trusted.crt | good.key          | a TRUSTED CERTIFICATE of OpenSSL                    | openssl x509 -in
bundle.crt  | good.key          | a bundle of PKCS#7                                  | openssl pkcs7 -print_certs
old.csr     | old.key           | a request for one                                   | the CA issued
nothing.pem | good.key          | nothing.pem contains no certificate;                | specify a PEM file
large.crt   | large.key         | certificate `large` has a key of P-521              | use P-256
short.crt   | short.key         | certificate `short` has a key of RSA with 1024 bits | use P-256
old.crt     | old.key           | certificate `old` is of X.509 version 1             | -extfile with a subjectAltName";

#[test]
fn a_file_that_holds_something_else_is_told_with_what_it_holds() {
    let dir = made();
    let dir = dir.path();
    for found in said(dir, "good.crt", "good.key") {
        assert_eq!(found, [""; 0]);
    }
    for [certificate, key, what, remedy] in rows(UNUSABLE) {
        for found in said(dir, certificate, key) {
            let [text] = found.as_slice() else {
                panic!("{certificate}, {key}: {found:#?}")
            };
            assert!(
                text.contains(what) && text.contains(remedy),
                "{certificate}, {key}: {text}"
            );
            assert!(!text.contains("OtherError"), "{text}");
        }
    }
    // Each of two swapped files is reported.
    for found in said(dir, "good.key", "good.crt") {
        assert_eq!(found.len(), 2, "{found:#?}");
        assert!(
            found
                .iter()
                .all(|text| text.contains("are certificate and key swapped?")),
            "{found:#?}"
        );
    }
}

#[test]
fn what_peers_will_refuse_is_a_warning() {
    let dir = made();
    let dir = dir.path();
    let [http, modbus, mqtt] = said(dir, "nameless.crt", "nameless.key");
    for found in [http, modbus] {
        let [text] = found.as_slice() else { panic!("{found:#?}") };
        assert!(
            text.contains("certificate `nameless` in ") && text.contains("names no host"),
            "{text}"
        );
    }
    assert_eq!(mqtt, [""; 0], "a client needs no names");

    let of_ca = |ca: &str, host: &str| {
        let ca = dir.join(ca).display().to_string();
        messages(&format!("[mqtt]\nurl = \"mqtts://{host}\"\nca = {ca:?}\n"))
    };
    for (ca, host) in [
        ("good.crt", "anywhere"),
        ("own.crt", "127.0.0.1"),
        ("own.crt", "HALL.local"),
        ("old.crt", "old"),
    ] {
        assert_eq!(of_ca(ca, host), [""; 0], "{ca} {host}");
    }
    for (ca, host, what) in [
        (
            "own.crt",
            "10.0.0.5",
            "is not a CA and is for `hall.local`, `127.0.0.1`, not for `10.0.0.5`",
        ),
        (
            "large.crt",
            "127.0.0.1",
            "has a key of P-521, which the gateway does not support",
        ),
        ("short.crt", "127.0.0.1", "has a key of RSA with 1024 bits"),
        ("good.key", "127.0.0.1", "contains no certificate, but a private key"),
    ] {
        let found = of_ca(ca, host);
        let [text] = found.as_slice() else {
            panic!("{ca}: {found:#?}")
        };
        assert!(text.contains(what), "{text}");
    }
}
