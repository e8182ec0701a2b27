use super::*;
use clap::Parser;

#[derive(Debug, Parser)]
struct Command {
    #[command(flatten)]
    args: Args,
}

fn parse(words: &str) -> Result<Args, String> {
    let words = std::iter::once("simulate").chain(words.split_whitespace());
    Command::try_parse_from(words)
        .map(|command| command.args)
        .map_err(|error| error.to_string())
}

#[test]
fn a_line_from_the_command_line() {
    let args = parse("--addresses 1-10 --link /tmp/l --baud 9600 --format 8E1 --fault drop=0.5 --chunk 14 --lenient");
    let args = args.unwrap();
    let line = args.applied_to(args.line().unwrap());
    assert_eq!(line.drives.len(), 10);
    assert_eq!(line.rules.format.to_string(), "9600 8E1");
    assert_eq!((line.rules.delivery, line.rules.strict), (Delivery::Chunks(14), false));
    assert_eq!(
        line.endpoint,
        EndpointOptions::Pty {
            link: Some("/tmp/l".into())
        }
    );
    assert!(line.drives.iter().all(|drive| drive.autopilot.is_none()));
    let args = parse("--listen 127.0.0.1:4001 --autopilot --speed max").unwrap();
    let line = args.applied_to(args.line().unwrap());
    assert!(!line.boards.leading_byte);
    let n2 = parse("--profile vacon-nx-n2 --link /tmp/l --n2-leading-byte").unwrap();
    assert!(n2.applied_to(n2.line().unwrap()).boards.leading_byte);
    assert_eq!(line.rules.wire, Wire::Instant);
    assert!(line.drives.iter().all(|drive| drive.autopilot.is_some()));
}

#[test]
fn boards_that_count_from_one() {
    let offset = |words: &str| {
        let args = parse(words).unwrap();
        let line = args.applied_to(args.line().unwrap());
        line.drives
            .iter()
            .map(|drive| match &drive.model {
                ModelOptions::Cx(cx) => cx.offset,
                other => panic!("{other:?}"),
            })
            .collect::<Vec<_>>()
    };
    let none = AddressOffset::default();
    assert_eq!(offset("--profile vacon-cx"), [none]);
    let wanted = AddressOffset {
        discrete_input: 1,
        holding: 1,
        ..none
    };
    let words = "--profile vacon-cx --addresses 1-2 --cx-address-offset holding=1,discrete-input=1,coil=0";
    assert_eq!(offset(words), [wanted; 2]);
    let all = AddressOffset {
        coil: 1,
        discrete_input: 1,
        input: 1,
        holding: 1,
    };
    assert_eq!("coil=1, input=1,holding=1,discrete-input=1".parse(), Ok(all));
    for bad in ["", "holding", "holding=2", "holding=-1", "hold=1", "holding=1,"] {
        assert!(bad.parse::<AddressOffset>().is_err(), "{bad}");
    }
    let error = parse("--profile vacon-cx --cx-address-offset coils=1").unwrap_err();
    assert!(error.contains("does not name a table; write coil, "), "{error}");
    let error = parse("--cx-address-offset coil=1").unwrap().line().unwrap_err();
    assert!(error.contains("`vacon-nx` have no address offset"), "{error}");
}

#[test]
fn bad_command_lines() {
    for bad in [
        "--link /tmp/l --port /dev/ttyUSB0",
        "--config a.toml --link /tmp/l",
        "--baud 12",
        "--turnaround 5",
        "--listen foo",
        "--fault drop",
        "--addresses 0-3",
        "--speed warp",
    ] {
        assert!(parse(bad).is_err(), "{bad}");
    }
    let error = parse("--profile vacon-nv").unwrap().line().unwrap_err();
    assert!(error.contains("did you mean `vacon-nx`"), "{error}");
    assert!(parse("--format 9N1").unwrap().line().unwrap_err().contains("--format"));
    assert!(parse("--format 8N1").unwrap().line().is_ok());
    let error_of = |words: &str| parse(words).unwrap().line().unwrap_err();
    let error = error_of("--protocol n2");
    assert!(
        error.contains("speak modbus-rtu") && error.contains("`vacon-nx-n2`"),
        "{error}"
    );
    let error = error_of("--profile teco-7300pa --addresses 30-32");
    assert!(error.contains("no address 32") && error.contains("1 to 31"), "{error}");
    assert!(error_of("--addresses 250").contains("its drives have 1 to 247"));
    assert!(
        parse("--profile teco-7300pa-n2 --addresses 250-255")
            .unwrap()
            .line()
            .is_ok()
    );
    assert!(parse("--protocol profibus").unwrap_err().contains("modbus-ascii"));
}

#[test]
fn the_documentation_names_every_fault() {
    let page = include_str!("../../../../docs/simulate.md");
    for name in names().split(", ") {
        assert!(page.contains(&format!("`{name}`")), "docs/simulate.md lacks {name}");
    }
}

#[test]
fn every_built_in_profile_can_be_simulated() {
    let profiles = Profiles::built_in();
    for profile in profiles.iter() {
        let name = &profile.name;
        let args = parse(&format!("--profile {name}")).unwrap();
        let line = args.applied_to(args.line().unwrap());
        assert_eq!(Some(&line.rules.protocol), profile.protocols.first(), "{name}");
        let baud = line.rules.format.baud;
        assert!(
            profile.bauds.is_empty() || profile.bauds.contains(&baud),
            "{name}: {baud}"
        );
        let address = line.drives[0].model.trip_address().to_string();
        let help = trip_registers().replace(',', " ");
        match &line.drives[0].model {
            ModelOptions::Profile(of) => {
                let own = profile.simulator.is_some() || profile.control_table().is_none();
                assert!(own && of.turnaround == Some(profile.turnaround), "{name}");
                assert_eq!(address, "9998", "{name}");
            }
            _ => {
                let word = format!("{} ", profile.simulator.as_deref().unwrap());
                assert!(help.contains(&word) && help.contains(&address), "{name}");
            }
        }
    }
    let line = |words: &str| {
        let args = parse(words).unwrap();
        args.applied_to(args.line().unwrap())
    };
    let teco = line("--profile teco-7300pa");
    assert_eq!(teco.rules.format.to_string(), "19200 7N2");
    assert_eq!(teco.drives[0].model.turnaround(), Some(Duration::from_millis(15)));
    let answers = |line: SimulatedBusOptions| matches!(&line.drives[0].model, ModelOptions::Teco(teco) if teco.answer_check_error);
    assert!(!answers(teco));
    assert!(answers(line("--profile teco-7300pa --teco-answer-check-error")));
    let teco = line("--profile teco-7300pa --turnaround 3ms");
    assert_eq!(teco.drives[0].model.turnaround(), None);
    assert_eq!(teco.rules.turnaround, Duration::from_millis(3));
    assert_eq!(line("--profile vacon-cx").rules.format.to_string(), "19200 8N2");
    assert_eq!(line("--profile vacon-nx-n2").rules.format.to_string(), "9600 8N1");
    assert_eq!(line("").rules.format.to_string(), "38400 8N1");
}

/// A user profile: by its file, by a directory, with values; and errors in each.
#[test]
fn profiles_of_the_user_are_simulated() {
    let directory = tempfile::tempdir().unwrap();
    let path = |name: &str| directory.path().join(name).display().to_string();
    let write = |name: &str, text: &str| std::fs::write(path(name), text).unwrap();
    let meter = "name = \"meter\"\nprotocols = [\"modbus-rtu\"]\nbauds = [9600]\nturnaround = \"7ms\"\n\
                 [[range]]\ntable = \"input\"\nfirst = 0\nlast = 9\nread = 4\n\
                 [[point]]\nname = \"voltage\"\nat = \"input 0\"\nscale = 0.1\nunit = \"V\"\nclass = \"fast\"\n\
                 [[point]]\nname = \"tariff\"\nat = \"input 1\"\ntexts = { 1 = \"day\", 2 = \"night\" }\n\
                 [[point]]\nname = \"serial\"\nat = \"input 2\"\ntype = \"string:3\"\n";
    write("meter.toml", meter);
    let error_of = |words: &str| parse(words).unwrap().line().unwrap_err();
    let file = path("meter.toml");
    let args = parse(&format!(
        "--profile {file} --set voltage=231.5 --set tariff=night --set serial=A1"
    ))
    .unwrap();
    let line = args.applied_to(args.line().unwrap());
    assert_eq!(line.rules.format.baud, 9600);
    let ModelOptions::Profile(of) = &line.drives[0].model else {
        panic!("{:?}", line.drives[0].model);
    };
    assert_eq!(of.turnaround, Some(Duration::from_millis(7)));
    let given: Vec<&Given> = of.values.values().collect();
    assert_eq!(
        given,
        [
            &Given::Number(231.5),
            &Given::Number(2.0),
            &Given::Text("A1".to_string())
        ]
    );
    let dir = directory.path().display();
    assert!(
        parse(&format!("--profile meter --profile-dir {dir}"))
            .unwrap()
            .line()
            .is_ok()
    );
    for (words, wanted) in [
        (format!("--profile {file} --set voltag=1"), "did you mean `voltage`?"),
        (format!("--profile {file} --set voltage"), "write POINT=VALUE"),
        (
            format!("--profile {file} --set voltage=high"),
            "`high` is not a value of `voltage`",
        ),
        ("--set voltage=1".to_string(), "come from its simulated motor"),
        (format!("--profile {}", path("none.toml")), "none.toml"),
    ] {
        let error = error_of(&words);
        assert!(error.contains(wanted), "{words}: {error}");
    }
    write(
        "odd.toml",
        &meter.replace("name = \"meter\"", "name = \"odd\"\nsimulator = \"odd\""),
    );
    assert!(error_of(&format!("--profile {}", path("odd.toml"))).contains("unknown simulator `odd`"));
    write("bad.toml", "name = \"bad\"");
    assert!(error_of(&format!("--profile {}", path("bad.toml"))).contains("protocols"));
}

#[test]
fn the_endpoint_of_a_configured_bus() {
    assert_eq!(
        endpoint_for("/dev/ttyUSB0"),
        Ok(EndpointOptions::Pty {
            link: Some("/dev/ttyUSB0".into())
        })
    );
    let listen = "127.0.0.1:4001".parse().unwrap();
    assert_eq!(
        endpoint_for("tcp://127.0.0.1:4001"),
        Ok(EndpointOptions::Tcp { listen })
    );
    assert_eq!(
        endpoint_for("modbus-tcp://127.0.0.1:4001"),
        Ok(EndpointOptions::ModbusTcp { listen })
    );
    assert_eq!(
        endpoint_for("udp://127.0.0.1:4001"),
        Ok(EndpointOptions::Udp { listen })
    );
    let dial = EndpointOptions::Dial {
        server: listen,
        text: "USR-0001".to_string(),
    };
    assert_eq!(endpoint_for("tcp-listen://127.0.0.1:4001?id=USR-0001"), Ok(dial));
    assert!(endpoint_for("tcp://127.0.0.1").is_err());
    assert!(endpoint_for("rfc2217://127.0.0.1:4001").is_err());
}
