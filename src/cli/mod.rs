//! The command line: what was typed becomes what is meant; results go to stdout, everything else to stderr.

mod bench;
mod bias;
mod chosen;
mod compare;
pub mod demo;
mod devices;
mod diagnostics;
pub mod eval;
mod inspect;
mod interrupt;
mod mesh;
mod output;
mod page;
mod profile;
mod progress;
mod render;
mod scene_args;
mod settings;
mod study;
mod suggestion;
mod timing;
mod train;

use clap::{
    ArgAction, Args, ColorChoice, CommandFactory, FromArgMatches, Parser, Subcommand, ValueEnum,
};
use std::io::IsTerminal;
use std::panic::AssertUnwindSafe;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::LazyLock;

pub use output::Context;

/// Version and, where the build knew it, the commit.
static VERSION: LazyLock<String> = LazyLock::new(|| match option_env!("NEURODIN_GIT_HASH") {
    Some(hash) if !hash.is_empty() => format!("{} ({hash})", env!("CARGO_PKG_VERSION")),
    _ => env!("CARGO_PKG_VERSION").into(),
});

/// Photographs to triangle meshes with neural surfaces (NeuRodin), on any Vulkan device
#[derive(Parser)]
#[command(
    name = "neurodin",
    version = VERSION.as_str(),
    arg_required_else_help = true,
    subcommand_required = true,
    after_help = "\
Example:
  neurodin inspect photos/
  neurodin train photos/ --out run --preset outdoor-tiny
  neurodin mesh run -o mesh.ply

Exit codes:
  0    done
  1    unexpected error
  2    wrong usage
  3    unusable input data or configuration
  4    no suitable Vulkan device
  5    out of device or host memory
  6    device lost
  7    numbers that are no longer finite
  8    output that exists already or cannot be written
  130  interrupted, after a checkpoint

Every flag that names an environment variable can be set by it."
)]
struct Cli {
    #[command(flatten)]
    global: Global,
    #[command(subcommand)]
    command: Command,
}

/// Flags of every command.
#[derive(Args, Clone, Debug)]
#[command(next_help_heading = "Global")]
struct Global {
    /// Vulkan device: its number in `neurodin devices`, or part of its name
    #[arg(long, global = true, value_name = "DEVICE", env = "NEURODIN_DEVICE")]
    device: Option<String>,
    /// Folder for compiled kernels and for what was measured of the device [default: neurodin in the user's cache folder]
    #[arg(long, global = true, value_name = "DIR", env = "NEURODIN_CACHE")]
    cache: Option<PathBuf>,
    /// Do not measure at the first start on a device which shapes of kernels are fastest there
    #[arg(long, global = true)]
    no_autotune: bool,
    /// Results as JSON on stdout
    #[arg(long, global = true)]
    json: bool,
    /// Nothing on stderr but errors
    #[arg(short, long, global = true, conflicts_with = "verbose")]
    quiet: bool,
    /// Say what is decided and touched; twice, how; three times, at every step, too (RUST_LOG chooses among them)
    #[arg(short, long, global = true, action = ArgAction::Count)]
    verbose: u8,
    /// How stderr is written; json: one object a line
    #[arg(
        long,
        global = true,
        value_enum,
        default_value_t,
        value_name = "FORMAT"
    )]
    log_format: LogFormat,
    /// Colours (auto: on a terminal, unless NO_COLOR is set)
    #[arg(long, global = true, value_enum, default_value_t, value_name = "WHEN")]
    color: Color,
    /// Run under the Vulkan validation layer
    #[arg(long, global = true, env = "NEURODIN_VALIDATION", hide = true, value_parser = clap::builder::FalseyValueParser::new())]
    validation: bool,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum LogFormat {
    #[default]
    Text,
    Json,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum Color {
    #[default]
    Auto,
    Always,
    Never,
}

#[derive(Subcommand)]
enum Command {
    Devices(devices::DevicesArgs),
    Inspect(inspect::InspectArgs),
    Train(Box<train::TrainArgs>),
    Mesh(mesh::MeshArgs),
    Render(render::RenderArgs),
    Eval(eval::EvalArgs),
    Profile(Box<profile::ProfileArgs>),
    Bench(bench::BenchArgs),
    Compare(Box<compare::CompareArgs>),
    Bias(Box<bias::BiasArgs>),
    Demo(demo::DemoArgs),
}

impl Command {
    fn run(&self, context: &Context) -> anyhow::Result<()> {
        match self {
            Command::Devices(args) => devices::run(args, context),
            Command::Inspect(args) => inspect::run(args, context),
            Command::Train(args) => train::run(args, context),
            Command::Mesh(args) => mesh::run(args, context),
            Command::Render(args) => render::run(args, context),
            Command::Eval(args) => eval::run(args, context),
            Command::Profile(args) => profile::run(args, context),
            Command::Bench(args) => bench::run(args, context),
            Command::Compare(args) => compare::run(args, context),
            Command::Bias(args) => bias::run(args, context),
            Command::Demo(args) => demo::run(args, context),
        }
    }
}

/// The whole program.
pub fn main() -> ExitCode {
    diagnostics::install_panic_hook();
    let color = color_wanted();
    let choice = match color {
        Color::Always => ColorChoice::Always,
        Color::Never => ColorChoice::Never,
        Color::Auto => ColorChoice::Auto,
    };
    let parsed = Cli::command()
        .color(choice)
        .try_get_matches()
        .and_then(|matches| Cli::from_arg_matches(&matches));
    let cli = match parsed {
        Ok(cli) => cli,
        Err(usage) => {
            // Help and version are results; what stands on a closed pipe was not wanted.
            let _ = usage.print();
            return ExitCode::from(usage.exit_code() as u8);
        }
    };
    let colored = match cli.global.color {
        Color::Always => true,
        Color::Never => false,
        Color::Auto => colored_by_environment(),
    };
    let context = Context::new(&cli.global, colored);
    if let Err(error) = diagnostics::install_log(&cli.global, colored) {
        return context.fail(&error.into());
    }
    // A panic has told its story in the hook; what is left is the exit code.
    let outcome = std::panic::catch_unwind(AssertUnwindSafe(|| cli.command.run(&context)));
    match outcome {
        Ok(Ok(())) => ExitCode::SUCCESS,
        Ok(Err(error)) => context.fail(&error),
        Err(_) => ExitCode::from(1),
    }
}

/// `--color`, which the help itself obeys too, so that it is needed before everything is parsed.
fn color_wanted() -> Color {
    let mut words = std::env::args_os().skip(1);
    while let Some(word) = words.next() {
        let word = word.to_string_lossy();
        let value = match word.strip_prefix("--color") {
            Some("") => words.next().unwrap_or_default().to_string_lossy().into(),
            Some(rest) => rest.trim_start_matches('=').to_string(),
            None => continue,
        };
        return Color::from_str(&value, true).unwrap_or_default();
    }
    Color::Auto
}

/// no-color.org and bixense.com/clicolors, for stderr.
fn colored_by_environment() -> bool {
    let set = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty());
    if set("NO_COLOR").is_some() {
        return false;
    }
    if set("CLICOLOR_FORCE").is_some_and(|value| value != "0") {
        return true;
    }
    std::io::stderr().is_terminal() && set("TERM").is_none_or(|value| value != "dumb")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_grammar_is_sound() {
        Cli::command().debug_assert();
    }
}
