//! The programs that tests talk to. A program that is missing fails the test: it does not pass by not running.

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

/// The root directory of the repository.
pub(crate) fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// The path of a program in `.tools`, on the `PATH`, or among the daemons in `/usr/sbin`.
pub(crate) fn tool(name: &str) -> PathBuf {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let own = [".tools/venv/bin", ".tools/bin"].map(|dir| root().join(dir));
    let found = own
        .into_iter()
        .chain(std::env::split_paths(&path))
        .chain([PathBuf::from("/usr/sbin")])
        .map(|dir| dir.join(name))
        .find(|file| file.is_file());
    found.unwrap_or_else(|| panic!("`{name}` is not installed; run tests/tools/install.sh, which `make test` does"))
}

/// The Python that has the packages of `requirements.txt`.
pub(crate) fn python() -> PathBuf {
    let python = root().join(".tools/venv/bin/python");
    assert!(
        python.is_file(),
        "{} is missing; run tests/tools/install.sh, which `make test` does",
        python.display()
    );
    python
}

/// Runs a program until it ends.
pub(crate) fn run(program: &Path, arguments: &[&str]) -> Output {
    Command::new(program)
        .args(arguments)
        .current_dir(root())
        .output()
        .unwrap_or_else(|error| panic!("cannot run {}: {error}", program.display()))
}

/// Runs a program that must succeed; returns its output, standard error first.
pub(crate) fn run_well(program: &Path, arguments: &[&str]) -> String {
    let output = run(program, arguments);
    let printed = [output.stderr, output.stdout].concat();
    let printed = String::from_utf8_lossy(&printed).into_owned();
    assert!(
        output.status.success(),
        "{} {}: {}\n{printed}",
        program.display(),
        arguments.join(" "),
        output.status
    );
    printed
}

/// Runs a program until it ends, with `input` on its standard input.
pub(crate) fn feed(program: &Path, arguments: &[&str], input: &str) -> Output {
    let mut child = Command::new(program)
        .args(arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap_or_else(|error| panic!("cannot start {}: {error}", program.display()));
    let mut stdin = child.stdin.take().unwrap();
    stdin.write_all(input.as_bytes()).unwrap();
    drop(stdin);
    child.wait_with_output().unwrap()
}
