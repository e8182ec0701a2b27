//! The inputs in `fuzz/seeds`, once each, through the targets of the fuzzer.

use crate::support::tools::root;

/// Declares the fuzz targets, and runs the one with this name.
macro_rules! targets {
    ($($name:ident $file:literal,)*) => {
        $(#[path = $file] mod $name;)*

        const TARGETS: &[(&str, fn(&[u8]))] = &[$((stringify!($name), $name::run),)*];
    };
}

targets! {
    ascii "../../fuzz/cases/ascii.rs",
    audit_file "../../fuzz/cases/audit_file.rs",
    bacnet "../../fuzz/cases/bacnet.rs",
    capture "../../fuzz/cases/capture.rs",
    certificate "../../fuzz/cases/certificate.rs",
    configuration "../../fuzz/cases/configuration.rs",
    http_request "../../fuzz/cases/http_request.rs",
    message_log "../../fuzz/cases/message_log.rs",
    modbus_tcp_stream "../../fuzz/cases/modbus_tcp_stream.rs",
    mqtt_set "../../fuzz/cases/mqtt_set.rs",
    n2 "../../fuzz/cases/n2.rs",
    profile "../../fuzz/cases/profile.rs",
    rtu "../../fuzz/cases/rtu.rs",
}

#[test]
fn every_seed_of_every_target() {
    let manifest = std::fs::read_to_string(root().join("fuzz/Cargo.toml")).unwrap();
    assert_eq!(
        manifest.matches("[[bin]]").count(),
        TARGETS.len(),
        "a target is not replayed"
    );
    for (name, run) in TARGETS {
        let dir = root().join("fuzz/seeds").join(name);
        let seeds: Vec<_> = std::fs::read_dir(&dir)
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .collect();
        assert!(seeds.len() >= 3, "{name} has {} seeds", seeds.len());
        for seed in seeds {
            eprintln!("{}", seed.display());
            run(&std::fs::read(seed).unwrap());
        }
    }
}
