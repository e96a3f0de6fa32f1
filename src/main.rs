//! The program `neurodin`; everything is in [`neurodin::cli`].

fn main() -> std::process::ExitCode {
    neurodin::cli::main()
}
