//! `corotate`: the program of this crate's rigs and scenarios. A program of your own names yours instead.

use corotate::Program;
use std::process::ExitCode;

fn main() -> ExitCode {
    let program = Program::new().rigs(corotate::scenario::shipped());
    let program =
        corotate::config::SHIPPED.into_iter().fold(program, |program, (name, text)| program.scenario(name, text));
    corotate::campaign::SHIPPED.into_iter().fold(program, |program, (name, text)| program.campaign(name, text)).main()
}
